"""A run as a recording for Foxglove and whatever else reads MCAP: its messages are those of ROS 2."""
