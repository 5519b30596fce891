"""Trackers of others, run on the same recordings."""
