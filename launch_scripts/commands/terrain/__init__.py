"""Commands about a terrain, without a swarm."""
