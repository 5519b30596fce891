"""The experiments of `rstrack bench`: each is a list of cells, and what is made of their records."""
