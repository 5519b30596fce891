"""To look at: a video of both shutters, and a rerun recording."""
