"""Fault injection: what happens to a camera in the field, put into a recording. See `benchmarks.faults.faults`."""
