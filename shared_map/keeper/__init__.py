"""The keeper: a replica that writes every set of marks to its store, and answers for all authors, above all for
those that are gone. One runs in a swarm, or several, which hold the same.

- A mark is acknowledged once it is on a keeper's disk: the keeper's digest names what it has committed, and nothing
  else (`mark_store`). A store survives kill -9 at any instant, and a row that the disk has changed is noticed
  (`sealed_database`).
- Mark sets of dead authors shrink to the marks that can still win (`compaction`), and are restored if such an
  author turns out to live.
- Operators order at a keeper: zones, which are marks of authors of their own (`zone_orders`), and all else, in
  books that all keepers merge (`order_service`). An answer promises that the order is on the disk.
- A machine without the files of a terrain gets them from a keeper (`base_map`).

`service` is the shell that joins these, `main` the process.
"""
