"""What comes in from ROS: robots, goals, targets, areas and services. Pure parts beside one shell, `Incoming`."""
