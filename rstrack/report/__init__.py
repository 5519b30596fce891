"""One self-contained HTML page of a tracking run or of a benchmark: tables, plots, pictures."""
