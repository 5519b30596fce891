"""A sequence in other tools' layouts: Kalibr, EuRoC/ASL, registered TUM, ROS, COLMAP, nerfstudio, video, rerun."""
