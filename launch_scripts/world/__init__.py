"""What is outside the swarm: targets that move on the true ground, and the referee who sees it."""
