"""Figures: what they show, and the two that draw them, one for files and one for the HTML page."""
