"""Numbers of right of way that hosts, members and wardens agree on: lives, epochs, how often somebody speaks."""

from __future__ import annotations

from swarm.clock import NS_PER_S

BEAT_NS = NS_PER_S // 5
"""What has not changed is told again so often: so the members know of a warden, and a warden of its hosts."""
FURTHEST_EPOCH = 3 << 20
"""No run gets so many epochs further while somebody does not hear of it."""
_LIFE_BITS = 32
_FURTHEST_LIFE = 1 << 16


def first_life(after: int, chance: int) -> int:
    """A new life's number: greater than all that are known. Of two that begin at once, chance decides."""
    return ((after >> _LIFE_BITS) + 1 << _LIFE_BITS) | (chance & 0xFFFF_FFFF)


def is_far_ahead(life: int, known: int) -> bool:
    """Whether a number is further ahead than a host can have been restarted."""
    return life >> _LIFE_BITS > (known >> _LIFE_BITS) + _FURTHEST_LIFE
