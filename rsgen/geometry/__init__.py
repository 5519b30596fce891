"""Rigid motions, splines, cameras and shutters in float64 NumPy: the geometry that generator and tracker share."""
