"""Wire format: messages by subject, topics with their keys, and the codec.

- `topics` is the table of every key: its message, its access rules (put, serve, ask, hear; `access`), its priority.
- `messages` has a module for each subject. A message is a frozen struct; its `schema`, "marks/8", names type and
  version. `versions` says which versions a build reads and writes, so that two neighbours share a run.
- `fields` has the types of fields, each with its bounds, and columns of numbers as little-endian bytes.
- `codec` is the only door. `decode` raises nothing but `ProtocolError`, in bounded time and memory, and what it
  returns keeps every rule that the types state: a reader checks only what a message cannot know, such as the grid.
- `route_columns` has routes one by one, as arrays and as columns.

Work and memory that hostile messages make, and their bounds. Without certificates a stranger may do only what
`Topic.free` names. "Names" are bounds of dicts by sender, which there costs nothing to make up; with certificates
each sender has one name.

======================  ==========================================  ================================================
message                 work or memory                              bound
======================  ==========================================  ================================================
any payload             bytes to decode                             `Topic.put_bytes`, `ask_bytes`, `answer_bytes`
any sample              unread                                      `Topic.buffer`, 4,096 a topic (`runtime.inbox`)
any query               unread                                      4,096, and 1,024 an asker; askers take turns
marks                   cells changed; sets and marks held          quota and capacity by process (`author_limits`)
digest                  rows compared, asks, sets put again         a budget a tick, 16 asks, 256 sets a second
marks, asked            sets found and sent                         a budget a tick, by turns; 1,024 wait
route, cost, asked      routes walked, costs read                   1,000 routes, 2^19 steps; a budget a tick
route, asked by force   the tree grows                              once a tick for all that are no agents
obeyed, asked           rows compared until it is obeyed            64 wait, a budget of rows a tick
stats                   figures kept by keepers, and answered       4,096 names, 2^20 figures; 2^15 in an answer
base-map, base-tiles    pieces packed, beside the loop              a number of pieces in one request, a cache
fleet, status, lead     kept by observers                           2^14 names
chasers                 a tree of another class                     classes of the scenario; dropped after 60 s
pose, true-pose         trackers, poses of targets                  names of `runtime.tracker_ownership`
sighted                 kept by planners and keepers                10,000; saved for targets that there are
obstacle                cells closed                                256 obstacles, a radius of 100 m, a lease of 10
                                                                    s; 50,000 cells an id
believed, note          shown                                       the newest of each target; lines on show
zones, give-order       zones, orders, processes                    1,000 zones, 1,999 orders
run, asked              answers; strangers named                    one answer; 256 names
tokens                  planners looked up, questions               once a tick; a round of questions a second
other topics            from members of the run only                see `access`
======================  ==========================================  ================================================

A value is bounded where it enters and trusted inside. A new message needs a struct and a row of the table;
`docs/reference/wire.md` and `docs/wire.lock` are made of both.
"""
