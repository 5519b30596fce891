"""The `rsgen` command."""
