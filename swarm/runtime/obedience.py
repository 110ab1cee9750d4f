"""A process answers who asks whether it obeys an order, as soon as it does."""

from __future__ import annotations

from collections.abc import Callable

from swarm.bus.bus import Asked, Bus, Event, Post
from swarm.runtime.role import RoleSetup
from swarm.wire.messages.orders import Obey, Obeyed
from swarm.wire.topics import OBEYED

_MOST_WAITING = 64


class Obedience:
    """The queries of operators that wait until this process obeys.

    obeys  whether the process goes by an order now; called at ticks, and does what it takes to obey soon
    """

    def __init__(self, setup: RoleSetup, bus: Bus, post: Post, obeys: Callable[[Obey], bool]) -> None:
        self._obeyed = Obeyed(role=setup.role, id=setup.id, incarnation=setup.incarnation)
        self._bus = bus
        self._post = post
        self._obeys = obeys
        self._waiting: list[Asked] = []

    def start(self) -> None:
        self._bus.serve(OBEYED, self._post, role=self._obeyed.role, id=self._obeyed.id)

    def handle(self, event: Event) -> bool:
        """Whether the event was such a query, and is done with."""
        if not (isinstance(event, Asked) and isinstance(event.request, Obey)):
            return False
        if len(self._waiting) >= _MOST_WAITING:
            event.refuse(f"{_MOST_WAITING} orders wait here already")
            event.end()
        else:
            self._waiting.append(event)
        return True

    def tick(self) -> None:
        """Answer those whose order is obeyed now, and leave those who ask no more."""
        left: list[Asked] = []
        for asked in self._waiting:
            assert isinstance(asked.request, Obey)
            if asked.expired:
                asked.end()
            elif self._obeys(asked.request):
                asked.answer(self._obeyed)
                asked.end()
            else:
                left.append(asked)
        self._waiting = left
