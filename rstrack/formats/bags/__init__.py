"""ROS 1 and ROS 2 bags and MCAP, RealSense's among them: topics, messages, frames and shutters."""
