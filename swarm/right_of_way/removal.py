"""An operator says that a guest is gone, on the bus."""

from __future__ import annotations

import secrets

from swarm.bus.bus import Appeared, AskEnded, Bus, Heard, Replied
from swarm.clock import NS_PER_S, MonotonicClock
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.right_of_way.guest import Removal
from swarm.right_of_way.lock_regions import Plots
from swarm.runtime.inbox import Inbox
from swarm.wire.messages.traffic import Granted, Known, KnownRequest
from swarm.wire.topics import GRANTED, KNOWN, STANDING

_ANSWERS_S = 0.5
_TICK_S = 0.1


def say_gone(bus: Bus, name: str, grid: GridSpec, timeout_s: float) -> bool:
    """Say that a guest is gone, and wait until its cells are free. Returns whether they are within the timeout.

    bus  opened with the run's secret, or the guest's own certificate

    Raises ConfigError where no such guest is known, or it is no guest, or its program still runs.
    """
    inbox = Inbox()
    clock = MonotonicClock()
    bus.watch_alive(inbox.post)
    bus.subscribe(GRANTED, inbox.post, host=name)
    bus.ask(KNOWN, KnownRequest(agent=name, disk=0), inbox.post, tag="known", timeout_s=_ANSWERS_S)
    removal: Removal | None = None
    begun, due_ns = False, 0
    until_ns = clock.now_ns() + int(timeout_s * NS_PER_S)
    while (now_ns := clock.now_ns()) < until_ns:
        match inbox.take(_TICK_S):
            case Appeared(peer) if peer.id == name:
                raise ConfigError(f"{name} is alive: end its program, or let it leave with `swarm vehicle remove`")
            case Replied(message=Known() as known) if known.agents:
                if name in known.agents:
                    raise ConfigError(f"{name} is an agent of the scenario, not a guest: start it again instead")
                if removal is None or (not begun and known.plot_cells > removal.plots.side):
                    removal = Removal(Plots(grid, known.agents, known.plot_cells), name)
                if known.plot_cells == removal.plots.side:
                    removal.hear_known(known)
            case AskEnded() if removal is not None and not begun and removal.settled:
                if not removal.known:
                    raise ConfigError(f"no agent has ever heard of a guest {name!r}")
                removal.begin(secrets.randbits(32))
                begun = True
            case AskEnded() if not begun:
                bus.ask(KNOWN, KnownRequest(agent=name, disk=0), inbox.post, tag="known", timeout_s=_ANSWERS_S)
            case Heard(message=Granted() as granted) if removal is not None:
                removal.hear_granted(granted, now_ns)
            case _:
                pass
        if removal is not None and begun and now_ns >= due_ns:
            due_ns = now_ns + int(_TICK_S * NS_PER_S)
            for told in removal.tick(now_ns):
                for member in told.members:
                    bus.publish(STANDING, told.standing, plot=told.standing.plot, member=member, agent=name)
            if removal.done:
                return True
    return False
