"""The whole evaluation, `rstrack bench`: methods on sequences, tables beside the paper's figures, plots."""
