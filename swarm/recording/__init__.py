"""What enters and leaves a service, written down while it runs and fed to it again (decision 57).

A service is deterministic but for what it reads, so a recording is enough to repeat it:

1. `service_boundary` wraps the bus, the worker and whatever else is outside (`external_calls`). Whatever a service
reads or
   lets out crosses one of these wrappers, under one name for recording and for replay.
2. `recording` writes each call of the service with its time (start, tick, stop, or an event, by `events`), then
   what the call read, then key, length and digest of each output, as `records` of a file that can be torn anywhere.
3. `replaying` makes the service anew behind the same boundary, gives it the recorded calls and readings, and
   compares its outputs one by one. The first difference ends the replay and is named with its event.
4. `role_process` runs a role's service behind its boundary, from the opening of its bus to its end.

Results of a worker's jobs are not recorded, only when they were taken and what the job read: the job runs again.
Digests hold only what is compared, so a recording says that an output differs, not what it was.
"""
