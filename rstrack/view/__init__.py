"""Watching a tracker at work: images with residuals, path, keyframes and the growing map, in rerun."""
