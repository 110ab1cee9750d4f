"""The world outside the swarm: targets that move on the true terrain, and the referee."""
