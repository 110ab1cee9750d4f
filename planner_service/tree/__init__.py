"""The tree of one target over one map: costs and parents that lead every cell to it.

`cost_grid` is the map in the layout of kernels, `cost_changes` its changes. A tree has a cost in every cell
(`cost_to_go`) or is cut into pieces (`partitioned_tree`). `queue_choice` grows it, or a window of it, by the queue
that suits the costs, `partial_growth` only as far as its askers; `strides` thins it out far from its root;
`routes_with_bounds` reads routes from it with their bounds.
"""
