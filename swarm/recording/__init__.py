"""Inputs and outputs of a service, recorded while it runs and replayed later
(docs/design/simulation-and-replay.md).

A service is deterministic but for what it reads, so a recording is enough to repeat it:

1. `service_boundary` wraps the bus, the worker and whatever else is outside (`ExternalCalls`). All inputs and
   outputs of the service cross one of these wrappers, under one name for recording and for replay.
2. `record_inputs` writes each call of the service with its time (start, tick, stop, or an event), then its
   readings, then key, length and digest of each output. The file can be torn anywhere (`recording_file`).
3. `replay_service` makes the service again behind the same boundary, feeds it the recorded calls and readings, and
   compares its outputs one by one. The first difference ends the replay and is named with its event.
4. `record_inputs.run_role` runs a role's service behind its boundary, from the opening of its bus to its end.

Results of a worker's jobs are not recorded, only when they were taken and what the job read: the job runs again.
Outputs are recorded as digests: a recording shows that an output differs, but not its content.
"""

from swarm.errors import require

require(__name__, "numpy")
