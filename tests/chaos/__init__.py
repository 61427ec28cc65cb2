"""Faults that a run must survive without manual help: `make chaos`."""
