"""The spline as few poses a frame: what that loses, facts of the shutter, points of the surface to see it by."""
