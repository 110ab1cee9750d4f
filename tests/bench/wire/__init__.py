"""Benchmarks of the wire: marks, queries, positions and partitions, beside raw Zenoh."""
