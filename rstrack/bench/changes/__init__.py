"""What may be done to a recording or its camera file, one thing at a time: see `rstrack.bench.changes.named`."""

from rstrack.bench.changes.named import CHANGES, changed

__all__ = ["CHANGES", "changed"]
