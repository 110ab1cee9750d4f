"""The shared map without a master: every process holds a replica, and all become equal.

1. A *mark*, here a *statement*, says of one cell: this pace, lethal, or clear; with a stamp, and perhaps an end
   (`marks`). An author keeps all its statements about a tile of 32 x 32 cells in one *set*, under a number (epoch,
   seq). Its set with a higher number replaces the one with a lower number; no other process may write under its
   name.
2. *The merge law* (`merge`): of all statements about a cell that have not ended the newest wins, of two with one
   stamp that of the larger author; an operator's zone wins over all. It reads nothing but the sets that are held,
   so order, grouping and repetition of what arrives cannot matter: replicas that hold the same sets have the same
   winners. The map is a state-based CRDT: a last-writer-wins register for each (tile, author) in storage, for each
   cell in the map.
3. Stamps are *hybrid logical clocks*, one for each cell: an author that has seen a statement can overrule it,
   however far the clock of the other is ahead.
4. Sets are published when they change (`replica_sync`). A process that starts asks for all held sets (*late join*).
   Losses are found by *anti-entropy*: each replica publishes the numbers that it holds as a *digest* (`digest`),
   and a replica that misses a set asks its author and the keepers for it. A digest of late changes goes out between
   the whole ones. A digest has 64 KiB at most: a larger one goes out in parts, one at each tick, and the work of
   comparing in one tick is bounded. Only keepers name the sets of others, and a sender is a keeper by its name.
5. A keeper shrinks what dead authors left (`shared_map.keeper.compaction`). A set without any mark left becomes a
   *tombstone*: an empty set with a number between two of the author's, at which replicas drop the author's set and
   remember the number for a while (`held_sets`), so that a late copy is not accepted again. An author that is alive
   after all hears of it, and states the same again under a higher epoch.
6. *Limits* (`author_limits`): sets and statements held, in all and by process, are bounded, and each process has
   a budget of changed cells. Sets beyond the budget wait; sets beyond the bounds are refused and counted for
   any sender.
7. *Interest* (`interest`): a replica may hold only regions near its vehicles and only groups
   that it may read. Then it hears only the digests that can concern it.

`replica` is the core (sets, digests and time in; changed cells and sets to publish out), `replica_sync` its shell
on the bus.

Sources: Shapiro et al., Conflict-free Replicated Data Types (2011); Kulkarni et al., Logical Physical Clocks
(2014); Demers et al., Epidemic Algorithms for Replicated Database Maintenance (1987).
See docs/design/map-merge-law.md.
"""
