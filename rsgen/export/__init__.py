"""A sequence in the layouts of other tools: Kalibr, EuRoC/ASL, registered TUM RGB-D, video, rerun."""
