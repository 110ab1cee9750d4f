"""Replicas of the marks: the merge law, digests, tombstones, limits, and keeping replicas equal over the bus."""
