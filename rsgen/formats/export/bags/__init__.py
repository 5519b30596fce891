"""ROS 1 and ROS 2 bags and MCAP: a sequence as messages."""
