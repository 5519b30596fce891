"""What every command line shares: options and errors, progress bars, the scheduler."""
