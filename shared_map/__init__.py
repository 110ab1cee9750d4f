"""Terrain and marks become cost: what all processes share."""

from swarm.errors import require

require(__name__, "numpy")
