"""Light drawn by samples, from lamps, the sky and other surfaces: as many as it takes."""
