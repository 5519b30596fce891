"""Errors against the truth: of trajectories, of maps, of images."""
