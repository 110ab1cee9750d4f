"""Searches over padded arrays, compiled by numba: they see arrays only, no grid, map or message.

`layout` says what the arrays are, `decorators` how kernels are compiled and kept, `climbs` what a step's
rise does to its cost. Trees are grown by the queues, made exact again by `repair`, `costs_from_parents` and
`tile_*`, and thinned out far from their root by `stride_networks`. `partial_growth_kernels` finds how far a growth
must go, `route_kernels`, `any_angle_kernels` and `lower_bounds` read a tree.

Cells leave a queue in the order of their costs. There is one for each kind of search, as one for all would take 2.5
to 3 times as long (docs/design/bucket-queues.md, on two shared cores):

====================  ========================================================  ====================================
queue                 of                                                        why it stays
====================  ========================================================  ====================================
`queue_dial`          growths whose costliest step is at most 256 buckets       0.4 to 0.6 of the time of the next
`queue_wide_buckets`  growths over cell costs of any ratio                      any width is exact: the map decides
`queue_directed`      growths where uphill is not downhill                      a first offer is not the least there
`repair.spread`       changes of a tree                                         memory follows the changed cells
`heap_and_buckets`    strides, tiles of a partition: few cells, served by cost  a key may fall below what was served
====================  ========================================================  ====================================

The first three keep their buckets in `heap_and_buckets`.
"""
