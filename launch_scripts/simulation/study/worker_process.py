"""What Dask loads into each worker process of a local cluster before it works."""

from __future__ import annotations

import signal

# A Ctrl-C reaches the whole process group; the sweep alone acts upon it, and ends its workers.
signal.signal(signal.SIGINT, signal.SIG_IGN)
