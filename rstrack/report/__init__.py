"""One self-contained HTML page of a tracking run, a benchmark or a stress test: tables, plots, pictures."""
