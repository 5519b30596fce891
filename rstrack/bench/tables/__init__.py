"""Records as tables: what their figures are, what they say of their cells, averages, and the files written."""
