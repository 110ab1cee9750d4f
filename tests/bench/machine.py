"""The machine on which a figure was measured."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

from launch_scripts.observe.run_folder import processor


def machine() -> dict[str, Any]:
    """Cores, processor, Python version and load."""
    return {
        "cores": os.cpu_count(),
        "machine": processor(),
        "python": platform.python_version(),
        "load": round(os.getloadavg()[0], 1),
    }


def memory_free() -> int:
    """Bytes available without swapping; 4 GB where the system does not say."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return 4_000_000_000
