"""A run of a tracker over a recording: into a folder, resumed, told."""
