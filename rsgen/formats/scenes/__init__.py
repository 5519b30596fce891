"""Scenes of other programs, USD and Blender, as a folder with a Mitsuba scene in it."""
