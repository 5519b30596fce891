"""The trackers, frame by frame, and a run of one over a recording."""
