"""The cost-to-go tree of one target: edge costs, growth, windows, strides, lower bounds, routes."""
