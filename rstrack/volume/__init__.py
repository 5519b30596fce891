"""The signed distance volume and the mesh in it."""
