"""Recordings of phones' apps: Record3D and Stray Scanner, on ARKit."""
