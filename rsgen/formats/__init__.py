"""Formats of other programs, read and written: guests, which the generator itself works without."""
