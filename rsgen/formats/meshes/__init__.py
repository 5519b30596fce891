"""Scenes that are mesh files: their parts, materials, cut-outs and light."""
