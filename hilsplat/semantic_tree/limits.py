"""A limit that decides the memory of a semantic tree; a plan can import it without SciPy."""

MAX_ALL = 300  # scenes with at most this many views compare every view with every other
