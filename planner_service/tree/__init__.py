"""The cost-to-go tree of one target: edge costs, growth, windows, corridors, lower bounds, routes."""
