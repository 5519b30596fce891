"""What developers run to measure the project; it is no part of the package that is installed."""
