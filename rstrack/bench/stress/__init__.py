"""`rstrack bench stress`: what blur does, and what blur-aware weights gain."""
