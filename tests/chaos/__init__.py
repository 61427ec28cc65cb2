"""Faults that a run must survive without a person: `make chaos`."""
