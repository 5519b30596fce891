"""Training packs for rolling-shutter correction: pairs of rolling and global images in known layouts."""
