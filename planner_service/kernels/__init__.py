"""Searches over padded arrays, compiled by numba: they see arrays only, no grid, map or message.

`layout` says what the arrays are, `decorators` how kernels are compiled and kept, `climbs` what a step's
rise does to its cost. Trees are grown by the queues, made exact again by `repair`, `policy_iteration` and
`tile_*`, and thinned out far from their root by `stride_networks`. `partial_growth_kernels` finds how far a growth
must go, `route_kernels`, `any_angle_kernels` and `lower_bounds` read a tree.

Cells leave a queue in the order of their costs. There is one for each kind of search:

====================  ========================================================  ====================================
queue                 of                                                        why it stays
====================  ========================================================  ====================================
`dial_growth`         growths whose costliest step is at most 256 buckets       faster than the next; it can stop
`multilevel_growth`   other growths: any ratio of costs, uphill not downhill    a first offer is not the least there
`repair.spread`       changes of a tree                                         a heap takes 1.3 to 2 times as long
`heap_and_buckets`    strides, tiles of a partition: few cells, served by cost  a key may fall below what was served
====================  ========================================================  ====================================

The first two keep their buckets in `heap_and_buckets` (docs/design/bucket-queues.md).
"""
