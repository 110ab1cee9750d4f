"""Commands about a swarm that runs: where it is, how it is."""
