"""A vehicle that speaks MAVLink as a vehicle of the swarm: one process for each link (decision 76)."""
