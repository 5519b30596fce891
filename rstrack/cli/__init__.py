"""The `rstrack` command."""
