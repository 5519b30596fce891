"""Depth and colour along a known spline: fused keyframes, a signed distance volume, meshes and their errors."""
