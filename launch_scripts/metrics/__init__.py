"""The figures of a running swarm for Prometheus."""
