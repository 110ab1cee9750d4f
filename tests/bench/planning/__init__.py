"""Benchmarks of planning: full trees, strategies, gaps and the tables of the paper, beside other libraries."""
