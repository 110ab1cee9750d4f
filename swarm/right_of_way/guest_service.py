"""A guest on the bus: messages to calls of its core, and what that decides to the bus and to its file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from hashlib import blake2s

from swarm.bus.bus import Appeared, AskEnded, Bus, Disappeared, Event, Heard, Post, Replied
from swarm.clock import NS_PER_S
from swarm.errors import ConfigError
from swarm.grid import GridSpec
from swarm.liveness import Peer
from swarm.right_of_way.guest import Guest, SaveLives
from swarm.right_of_way.holdings import Tell
from swarm.right_of_way.host import AskKnown
from swarm.right_of_way.life_file import Lives
from swarm.right_of_way.lock_regions import Plots
from swarm.wire.fields import check_id
from swarm.wire.messages.traffic import Granted, Known, KnownRequest
from swarm.wire.topics import GRANTED, KNOWN, STANDING

_NOBODY_NS = 10 * NS_PER_S
"""A guest that nobody has answered for so long is told so."""
_ANSWERS_S = 0.3
"""A new life waits so long for the agents' answers before it begins."""
_ASK_AGAIN_NS = NS_PER_S
_ROLE = "rover"


class GuestService:
    """Right of way of one vehicle that is not in the scenario, on a bus that may carry other things, too.

    `handle` and `tick` are called by one thread, `tick` some ten times a second. The bus needs the run's secret, or
    a certificate of the guest, `rover.GROUP.NAME`.

    name         of the guest, as in its certificate; no agent of the scenario has it
    incarnation  nanosecond of this process's start, which tells its liveliness token from that of another
    warn         called with a sentence about what cannot be, or why the vehicle waits

    Raises ConfigError if the name is none.
    """

    def __init__(
        self,
        name: str,
        grid: GridSpec,
        incarnation: int,
        lives: Lives,
        bus: Bus,
        post: Post,
        warn: Callable[[str], None],
    ) -> None:
        try:
            check_id("guest", f"{name}-00")
        except ValueError as error:
            raise ConfigError(str(error)) from error
        self.name = name
        self.guest: Guest | None = None
        """None until an agent has said which agents there are."""
        self._grid = grid
        self._incarnation = incarnation
        self._lives = lives
        self._bus = bus
        self._post = post
        self._warn = warn
        self._warned: set[str] = set()
        self._tag = f"known-{name}"
        self._asking = False
        self._ask_due_ns = 0
        self._tokens: set[Peer] = set()
        self._began_ns = 0
        self._cell: int | None = None
        """Where to enter, once there is a guest."""

    def start(self, now_ns: int) -> None:
        self._bus.watch_alive(self._post, role=_ROLE)
        self._bus.subscribe(GRANTED, self._post, host=self.name)
        self._bus.declare_alive(Peer(_ROLE, self.name, self._incarnation))
        self._began_ns = now_ns
        self._ask(now_ns)

    def stop(self) -> None:
        self._bus.unsubscribe(GRANTED, host=self.name)

    def enter(self, cell: int, now_ns: int) -> None:
        """Ask for the cell on which the vehicle stands. Raises as `Guest.enter`."""
        if not 0 <= cell < self._grid.cells:
            raise ValueError(f"cell {cell} is outside the map of {self._grid.cells} cells")
        self._cell = cell
        if self.guest is not None:
            self.guest.enter(cell)
            if self.guest.needs_life and not self._asking:
                self._ask(now_ns)
        self.tell(now_ns)

    def leave(self, now_ns: int) -> None:
        """Give all cells back."""
        self._cell = None
        if self.guest is not None:
            self.guest.leave()
        self.tell(now_ns)

    def handle(self, event: Event, now_ns: int) -> bool:
        """True if the event was about the right of way of this guest."""
        match event:
            case Heard(topic=topic, message=Granted() as granted) if topic is GRANTED and granted.host == self.name:
                if self.guest is not None:
                    self.guest.hear_granted(granted, now_ns)
            case Replied(tag=self._tag, message=Known() as known):
                self._hear_known(known)
            case AskEnded(tag=self._tag):
                self._asking = False
                self._ask_due_ns = now_ns + _ASK_AGAIN_NS
                if self.guest is not None:
                    self._perform(self.guest.begin(self._chance(now_ns)), now_ns)
                    self.tell(now_ns)
            case Appeared(peer=peer) if (peer.role, peer.id) == (_ROLE, self.name):
                self._hear_token(peer, up=True)
            case Disappeared(peer=peer) if (peer.role, peer.id) == (_ROLE, self.name):
                self._hear_token(peer, up=False)
            case _:
                return False
        return True

    def tick(self, now_ns: int) -> None:
        settled = self.guest is not None and self.guest.settled
        if not settled and not self._asking and now_ns >= self._ask_due_ns:
            self._ask(now_ns)
        if self.guest is None and now_ns - self._began_ns > _NOBODY_NS:
            self._warn_once(
                (f"no agent answers {self.name}: a guest needs one that drives in this run, and a name of its own",)
            )
        self.tell(now_ns)
        if self.guest is not None:
            self._warn_once((*self.guest.refused, *self.guest.unled(now_ns)))
            self.guest.refused.clear()

    def tell(self, now_ns: int) -> None:
        """Send what is new, without waiting for the next tick."""
        if self.guest is not None:
            self._perform(self.guest.tick(now_ns), now_ns)

    def _hear_known(self, known: Known) -> None:
        if known.agents and (self.guest is None or _tells_of_larger(known, self.guest)):
            if self.name in known.agents:
                self._warn_once((f"{self.name} is an agent of this run's scenario: a guest needs another name",))
                return
            plots = Plots(self._grid, known.agents, known.plot_cells)
            self.guest = Guest(plots, self.name, self._lives.lives)
            for peer in self._tokens:
                self.guest.hear_token(peer, up=True)
            if self._cell is not None:
                self.guest.enter(self._cell)
        if self.guest is not None and known.plot_cells == self.guest.plots.side:
            self.guest.hear_known(known)

    def _hear_token(self, peer: Peer, *, up: bool) -> None:
        (self._tokens.add if up else self._tokens.discard)(peer)
        if self.guest is not None:
            self.guest.hear_token(peer, up=up)

    def _ask(self, now_ns: int) -> None:
        self._asking = True
        request = KnownRequest(agent=self.name, disk=0)
        self._bus.ask(KNOWN, request, self._post, tag=self._tag, timeout_s=_ANSWERS_S)

    def _perform(self, actions: Sequence[object], now_ns: int) -> None:
        for action in actions:
            match action:
                case AskKnown():
                    self._ask(now_ns)
                case SaveLives(lives):
                    self._lives.save(lives)
                case Tell(members, standing):
                    for member in members:
                        self._bus.publish(STANDING, standing, plot=standing.plot, member=member, agent=self.name)

    def _chance(self, now_ns: int) -> int:
        seed = f"{self.name}/{self._incarnation}/{now_ns}".encode()
        return int.from_bytes(blake2s(seed, digest_size=4).digest(), "little")

    def _warn_once(self, texts: Sequence[str]) -> None:
        for text in texts:
            if text not in self._warned and len(self._warned) < 100:
                self._warned.add(text)
                self._warn(text)


def _tells_of_larger(known: Known, guest: Guest) -> bool:
    """Whether plots are larger than the guest takes them to be. An agent says so only if this is so for the whole
    run; one that says less may not belong."""
    return known.plot_cells > guest.plots.side and not guest.cells
