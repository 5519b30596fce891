"""Layouts of calibration and odometry: Kalibr, EuRoC/ASL, and registered TUM folders."""
