"""Adapters to other systems, ROS 2 and MAVLink: each meets a running swarm by its client."""
