"""What there is to render: a scene from its XML file, placed and scaled, its meshes, boards and moving objects."""
