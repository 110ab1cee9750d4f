"""Starts, records and shows the swarm."""
