"""Adapters to other systems: ROS 2 and MAVLink."""
