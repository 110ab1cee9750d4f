"""Right of way: no two vehicles are in one cell, even if messages are lost, late or repeated and processes stop or
restart.

The map is divided into *shards* (`shards`). Three agents, or four where certificates prove names,
are the *members* of a shard. One of them is its *leader*, by epoch and majority. A *host* is a process with
vehicles in a shard or at its border. A *generation* is one numbered start of a host. The leader keeps an order of
*entries* for each cell (`host_entries`): the vehicle of an entry enters the cell once all before it are over. An
entry is never revoked and never runs out: only its host ends it.

The proof is in docs/design/right-of-way.md; docs/design/external-vehicles.md says how external vehicles come into
it. Hosts: `host`, `holdings`, `host_entries`, `generations`. Members: `shard_leader`, `shard_member`, and, where
certificates prove names, `shard_witness`. An agent (`agent_core`) is both. `agent_session` and `external_session`
carry the messages; `promise_store` and the file of generations keep what was said. All else is pure: time and
chance are arguments.

Duties of a host (`Host`, which keeps what it holds in `Holdings`):

1. Begin with a generation whose number is greater than any known number, and have it on file before the first
   word. First ask all agents (`KnownRequest`), until enough members of every shard have replied for one of them to
   have its newest usable table.
2. Tell each shard that concerns it everything about its vehicles there, whenever that is news and once a heartbeat.
   Entries that it omits are over. Send nothing for a vehicle which has only
   driven on, unless it runs short of cells or another waits behind it.
3. Enter a cell only by an entry that a `Granted` for this generation, newer than all that it knows of the shard,
   adds to the path of the vehicle, and only once all entries before it are over. Take no entry that an older table
   could have granted. Never go back to an older table of a shard, not even after the vehicles have left it. Where
   certificates prove names, act on a `Granted` once a majority of members has the same on file.
4. Say `Left` of what its vehicles have left or given back, to those who wait for it, again and again until a usable
   table lists it no more. Never use such an entry again.
5. Give back entries that wait for others which do not go on, and those further ahead than a vehicle keeps once
   another waits behind them.
6. Stop once a table names a greater generation of this host, and say so where the vehicles are simulated ones.
7. Speak to the leader, and to all members where no leader was heard for half a second, or certificates prove
   names.
8. Disclaim the entries that a member asks for and the host does not hold, and never take them.

Duties of a leader:

1. Add an entry at the end of a cell's order only, and one to a cell and table. Remove it only by a statement of its
   host that knows the table which added it, and does not list the entry, or by proof that its generation has ended.
2. Put a vehicle only behind one that goes on or will give back, and never so that it would wait for itself. Grant
   cells further ahead than a vehicle keeps only where no other is near.
3. Begin with the newest table that any of a majority has on file, and tell hosts of no table before a majority has
   it on file.
4. Plan all vehicles without a next cell at once (`pibt`), and append their entries to the orders of cells
   (`cell_orders`): a vehicle follows one that goes on.

Duties of a member:

1. Put the leader's table on file, under (epoch, number), before saying so (`Stored`). With the leader's own file
   one is a majority: then hosts receive the grants of the table.
2. Replace a leader that is silent for a lease: claim a higher epoch; the others promise to store no table of a
   lower one (Paxos). Promises are on file, too, before any message states them.
3. Where certificates prove names, judge each table before it is stored: then one member may lie. Hosts count the
   members themselves.

No clock decides anything but when to claim.

Messages (`swarm.wire.messages.traffic`), of which all but `Left` carry the whole state of their key, or its changes
since a state that the receiver has:

`HostState`     Host to leader: all vehicles of the host that hold or want a cell of one shard, each with its
                next cells (`Stand`, made of a `CellRequest`). `knows` is the newest table that the host acts on: of
                all entries up to that table, the host holds only those listed in this state. `dead` are generations
                that are proved to have ended, by which their entries are over.
`Table`         Leader to members: the entries of one shard, or those that differ from an earlier table. Its stamp
                is (epoch, seq).
`Stored`        Member to members: the table of this stamp is on file here. On two of three files it is usable. Said
                instead of storing changes since a table that is not on file here: then the leader sends all.
`Granted`       Leader to host: what a usable table says of the vehicles of one host, under its stamp, each entry
                with those before it, and which hosts follow. A host takes the entries that continue the path
                of the vehicle, and passes over the others, which gives them back. `pushed` asks a vehicle to make
                way into another shard; `occupied` are the cells of others around.
`Word`          Member to host, where certificates prove names: a digest of what its file grants to the host, and
                entries of which it lacks the host's statement.
`Left`          Host to host: these entries are over.
`Claim`         Member to members, where no leader was heard for 0.6 s, longer where round trips are: who answers
                with its table promises to store nothing of a lower epoch. The promises of a majority make a leader,
                which goes on from their newest table.
`KnownRequest`  New generation to all agents: what is on file of this host?
`Known`         The answer: the greatest generation in any table, the shards that list entries of the host, and, for
                an external vehicle, who the agents are and how large shards are.

An *external vehicle* (`ExternalVehicle`) is a host that is not in the scenario. It is a member of no shard, so who
joins and leaves changes no majority. It enters from nowhere: a host state asks for its first cell and holds
nothing. It leaves by a host state without the vehicle. The cells of a dead external vehicle stay shut until its
next generation proves, by the file which that has locked, that the process has ended, or until an operator removes
it (`Removal`): a generation which states that all generations, its own included, have ended.
"""
