"""Recordings: cameras, frames, camera files, noise, registration, and estimates on disk."""
