"""Independent checks of what was made: sequences, truth, ray casting, reprojection, light."""
