"""Measurements of the trackers: speed, starts, convergence."""
