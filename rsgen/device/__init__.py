"""What runs on the device (Dr.Jit, never Mitsuba): backend, arrays, recorded kernels, rolling-shutter projection."""
