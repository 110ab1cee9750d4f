"""Right of way for those who decide it: the members and leaders of shards, and where vehicles would go next.

The map is cut into shards (`swarm.right_of_way.shards`). Each shard has three members, which are agents, or
four where certificates prove names; one is its leader. The host's part is in `swarm.right_of_way`;
docs/design/right-of-way.md has the proof. Here:

1. A host tells the leader where its vehicles are and where they would go (`HostState`). `Steering` ranks the cells
   around a vehicle by its route. `CellRequests` keeps requests until one of their inputs changes.
2. The leader plans all vehicles without a next cell at once (`pibt`) and appends entries to the orders of cells
   (`cell_orders`): a vehicle follows one that goes on. An entry is never revoked: only its host's word ends it.
3. The leader sends its table to the other members, under (epoch, number). A member puts it on file and says so
   (`Stored`). With the leader's own file one is a majority: then hosts receive the grants of the table.
4. A leader that is silent for a lease is replaced: a member claims a higher epoch, and the others promise to store
   no table of a lower one (Paxos). The new leader begins with the newest table that a majority knows.
   Where certificates prove names, hosts count the members themselves, and a member judges each table before it
   stores it (`shard_witness`): then one member may lie.
5. Promises and stored tables are on file before any message states them. No clock decides anything but when to
   claim.

`RightOfWay` is one agent's part: its seats as a member, and its vehicles as a host. `Detours` leads vehicles around
obstacles, which speak no right of way.
"""
