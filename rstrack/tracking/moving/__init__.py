"""What moves by itself: found, grown to whole things, and left out."""
