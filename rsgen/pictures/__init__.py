"""Pictures of frames, sequences and meshes."""
