"""A live swarm under blows: killed and stopped processes, hostile messages; how soon it recovers."""
