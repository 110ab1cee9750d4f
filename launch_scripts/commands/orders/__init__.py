"""Orders to a running swarm."""
