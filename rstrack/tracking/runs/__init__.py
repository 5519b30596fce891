"""A run of a tracker over a recording: into a folder, and resumed."""
