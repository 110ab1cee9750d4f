"""The whole swarm in one process, on a memory bus and a manual clock, with seeded faults."""
