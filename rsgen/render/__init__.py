"""Rendering with Mitsuba 3: rolling-shutter sensor, samples of pixels, images, baked light."""
