"""Recordings of others' formats, turned into folders that the tracker reads: `rstrack import`."""
