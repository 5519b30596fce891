"""Dense tracking and mapping with rolling-shutter RGB-D cameras: the trajectory is a spline, every row has its pose."""
