"""Benchmarks of what travels: marks, queries, positions and partitions, beside raw Zenoh."""
