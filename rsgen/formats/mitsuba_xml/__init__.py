"""Scenes in XML: those of older Mitsubas upgraded, instances made into triangles, errors in one line."""
