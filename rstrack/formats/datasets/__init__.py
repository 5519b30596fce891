"""Layouts of datasets: EuRoC/ASL and ScanNet."""
