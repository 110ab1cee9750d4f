"""Wire format: messages by subject, topics with their keys, and the codec.

- `topics` is the table of every key: its message, its access rules (put, serve, ask, hear; `access`), its priority.
- `messages` has a module for each subject. A message is a frozen struct; its `schema`, "marks/8", names type and
  version. `versions` says which versions a build reads and writes, so that two neighbours share a run.
- `fields` has the types of fields, each with its bounds, and columns of numbers as little-endian bytes.
- `codec` is the only door. `decode` raises nothing but `ProtocolError`, in bounded time and memory, and what it
  returns keeps every rule that the types state: a reader checks only what a message cannot know, such as the grid.
- `route_columns` has routes one by one, as arrays and as columns.

A value is bounded where it enters and trusted inside. A new message needs a struct and a row of the table;
`docs/reference/wire.md` and `docs/wire.lock` are made of both.
"""
