"""Exact images that come with a colour frame on request: sharp and global-shutter twins, flow, normals, blur, depth."""
