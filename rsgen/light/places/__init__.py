"""Where on surfaces light is baked: points, what parts them, and smoothing and interpolation between them."""
