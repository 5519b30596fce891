"""Layouts of reconstruction: COLMAP, nerfstudio, and depth in the colour camera's pixels."""
