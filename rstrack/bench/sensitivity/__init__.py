"""`rstrack sensitivity`: what wrong stamps, cameras, images and frames do to a track."""
