"""Benchmarks of whole swarms: what they cost by number of vehicles, live and simulated, and how crowds drive."""
