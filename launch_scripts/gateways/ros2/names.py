"""How vehicles and targets of the swarm are called in ROS. Pure."""

from __future__ import annotations

import re


def ros_name(id: str) -> str:
    """An id as a part of a topic: a0-07 -> a0_07. ROS knows letters, digits and '_', and lets no part begin with a
    digit."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", id)
    return f"v{name}" if name[:1].isdigit() else name or "_"
