"""Timings of the generator against other ways to render the same frame."""
