"""How motion blur harms fusion and tracking, and what the blur-aware weights gain."""
