"""Irradiance of a scene: where it is sampled, how it is baked, where it is kept."""
