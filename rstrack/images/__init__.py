"""Images as kernels take them: pyramids, poses of their lines, sampling."""
