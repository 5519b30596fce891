"""Anybody's trajectories of a suite of sequences against the truth: `rstrack score`."""
