"""Rendering with Mitsuba 3: scene, rolling-shutter sensor, images, baked light."""
