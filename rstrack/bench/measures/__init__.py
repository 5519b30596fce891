"""What can be measured of a cell: a function each, see `rstrack.bench.task`."""
