"""Right of way: no two vehicles are in one cell, even if messages are lost, late or repeated and processes stop or
restart.

The map is divided into *shards* (`shards`). Three agents, or four where certificates prove names,
are the *members* of a shard. Each *epoch* of a shard names one of them as *leader*, which leads once a majority
has promised to follow. A *host* is a process with vehicles in a shard or at its border. A *generation* is one
numbered start of a host. For each cell the leader keeps an ordered list of *entries* (`host_entries`): the vehicle
of an entry may enter the cell once all entries before it are over. An entry is never revoked and never expires:
only its host ends it.

The proof is in docs/design/right-of-way.md; docs/design/external-vehicles.md extends it to external vehicles.
Modules of hosts: `host`, `holdings`, `host_entries`, `generations`. Modules of members: `shard_leader`,
`shard_member`, and, where certificates prove names, `shard_witness`. An agent (`agent_core`) is both host and
member. `agent_on_bus` and `external_on_bus` carry the messages. `promise_store` and the file of generations
keep statements on disk. All other modules are pure: they receive the time and random numbers as arguments.

Duties of a host (`Host`, which keeps what it holds in `Holdings`):

1. Begin with a generation whose number is greater than any known number, and have it on file before the first
   statement. Before that, ask all agents (`KnownRequest`) until enough members of every shard have replied: at
   least one of them then has the newest usable table of the shard.
2. State to each shard concerned everything about the vehicles there, when it has changed and once a heartbeat.
   Entries that a statement omits are over. Send nothing for a vehicle which has only driven on, unless it runs
   short of cells or another waits behind it.
3. Enter a cell only by an entry that a `Granted` has added to the path of the vehicle, and only once all entries
   before it are over. The `Granted` must be for this generation, and newer than all that the host knows of the
   shard. Take no entry that an older table could have granted. Never go back to an older table of a shard, not even
   after the vehicles have left it. Where certificates prove names, act on a `Granted` only once a majority of
   members has the same on file.
4. Send `Left` to the hosts which wait for an entry that a vehicle has left or given back. Repeat it until a usable
   table lists the entry no more. Never use such an entry again.
5. Give back entries that wait behind vehicles which do not go on. Once another vehicle waits, give back also the
   entries further ahead than a vehicle keeps.
6. Stop once a table names a greater generation of this host. If the vehicles are simulated, state that it stopped.
7. Send statements to the leader. Send them to all members if no leader was heard for half a second, or if
   certificates prove names.
8. Disclaim entries that a member asks for and the host does not hold, and never take them.

Duties of a leader:

1. Add an entry only at the end of a cell's list, and at most one per cell and table. Remove an entry only if its
   host states that it knows the table which added it, and does not list it, or by proof that its generation ended.
2. Put a vehicle only behind one that goes on or will give back, and never into a circle of vehicles which wait for
   each other. Grant cells further ahead than a vehicle keeps only if no other vehicle is near.
3. Begin with the newest table that a member of a majority has on file. Tell hosts of a table only once a majority
   has it on file.
4. Plan all vehicles without a next cell at once (`pibt`), and append their entries to the orders of cells
   (`cell_orders`): a vehicle follows one that goes on.

Duties of a member:

1. Put the leader's table on file, under (epoch, number), before confirming it (`Stored`). Of three members, the
   leader and one other are a majority: then hosts receive the grants of the table.
2. Replace a leader that is silent for a lease: claim a higher epoch. The others promise to store no table of a
   lower epoch (Paxos). Promises, too, are on file before any message states them.
3. Where certificates prove names, judge each table before storing it: one member may then lie. Hosts count for
   themselves the members which have a grant on file.

Clocks decide only when a member claims.

Messages (`swarm.wire.messages.traffic`), of which all but `Left` carry the whole state of their key, or its changes
since a state that the receiver has:

`HostState`     Host to leader: all vehicles of the host that hold or want a cell of one shard, each with its
                next cells (`Stand`, made of a `CellRequest`). `knows` is the newest table that the host acts on: of
                all entries up to that table, the host holds only those listed in this state. `dead` lists
                generations that are proved to have ended; their entries are over.
`Table`         Leader to members: the entries of one shard, or those that differ from an earlier table. Its stamp
                is (epoch, seq).
`Stored`        Member to members: the table of this stamp is on file here. On two of three files it is usable. Also
                the reply to changes since a table that is not on file here: then the leader sends all.
`Granted`       Leader to host: the entries of one host's vehicles in a usable table, under its stamp, each with the
                entries before it, and which hosts follow. A host takes the entries that continue the path of the
                vehicle. It passes over the others, and thereby gives them back. `pushed` asks a vehicle to make
                way into another shard; `occupied` are the cells of others around.
`Word`          Member to host, where certificates prove names: a digest of what its file grants to the host, and
                entries of which it lacks the host's statement.
`Left`          Host to host: these entries are over.
`Claim`         Member to members, if no leader was heard for 0.6 s, or longer if round trips are long. A member
                that answers with its table promises to store nothing of a lower epoch. With the promises of a
                majority the claiming member leads, and continues from the newest of their tables.
`KnownRequest`  New generation to all agents: what is on file of this host?
`Known`         The answer: the greatest generation in any table, the shards that list entries of the host, and, for
                an external vehicle, who the agents are and how large shards are.

An *external vehicle* (`ExternalVehicle`) is a host that is not in the scenario. It is a member of no shard, so it
changes no majority when it joins or leaves. It enters from nowhere: a host state asks for its first cell and holds
nothing. It leaves by a host state without the vehicle. The cells of a dead external vehicle stay closed until its
next generation proves that the process has ended, because it could lock the file of that process, or until an
operator removes it (`Removal`): a generation which states that all generations, its own included, have ended.
"""
