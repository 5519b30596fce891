"""`rstrack bench`: every method on every sequence, beside the paper's figures."""
