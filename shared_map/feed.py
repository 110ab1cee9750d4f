"""The bus side of a replica: what planner, agent, monitor and keeper services embed to take part in the map."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from shared_map.digest import Held
from shared_map.quota import Quota
from shared_map.replica import MapReplica, PublishSet
from swarm.bus import Asked, AskEnded, Bus, Event, Heard, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config import MapConfig
from swarm.messages import Digest, MarkSet, MarksRequest
from swarm.topics import DIGEST, MARKS

log = logging.getLogger(__name__)

_JOIN = "map-join"
_RESYNC = "map-resync:"
_JOIN_TIMEOUT_S = 5.0
_JOIN_TRIES = 5
_GRACE_NS = NS_PER_S // 10
"""A digest may overtake the sets that it tells of: only what is missing after this is asked for."""
_RETRY_NS = NS_PER_S // 2
_NAME_AGAIN_NS = 60 * NS_PER_S
_ASKS_AT_ONCE = 16
_OFFERS_AT_ONCE = 256


@dataclass(slots=True)
class _Claim:
    """A digest that still has to be compared with what we hold."""

    digest: Digest
    due_ns: int
    tries: int = 0


class MapFeed:
    """Keeps a replica in step with everybody else's.

    Call `handle` and `tick` before the service's own work; publish what the replica's `write` returns with
    `publish`. The roles: whoever has an author serves and digests its own sets; a keeper serves everybody's
    (`serves_all`) and digests what `held` says, which is what it has committed.

    joined  the late join is over: somebody answered, or nobody was there to ask
    """

    def __init__(
        self,
        replica: MapReplica,
        bus: Bus,
        post: Post,
        config: MapConfig,
        role: str,
        *,
        name: str | None = None,
        serves_all: bool = False,
        held: Callable[[], dict[str, bytes]] | None = None,
        on_accepted: Callable[[MarkSet], None] | None = None,
    ) -> None:
        self.replica = replica
        self.joined = False
        self._bus = bus
        self._post = post
        self._role = role
        self._name = name or replica.author
        self._serves_all = serves_all
        self._held = held or replica.own_digest
        self._on_accepted = on_accepted
        self._quota = Quota(config.author_marks_per_s, config.total_marks_per_s)
        self._named_ns: dict[str, int] = {}
        self._digest_ns = int(config.digest_s * NS_PER_S)
        self._digest_due_ns = 0
        self._join_due_ns: int | None = None
        self._join_tries = 0
        self._claims: dict[str, _Claim] = {}
        self._asking: dict[str, int] = {}  # author -> when asked for
        self._heard_ns: dict[str, int] = {}
        self._kept: Held | None = None
        self._started_ns = 0

    def start(self, now_ns: int) -> None:
        """Subscribe, serve, and ask for all that was said before."""
        self._started_ns = now_ns
        self._bus.subscribe(MARKS, self._post)
        self._bus.subscribe(DIGEST, self._post)
        if self._serves_all:
            self._bus.serve(MARKS, self._post)
        elif self.replica.author is not None:
            self._bus.serve(MARKS, self._post, author=self.replica.author)
        self._join()

    def handle(self, event: Event, now_ns: int) -> bool:
        """True if the event was about the map and nobody else's business."""
        match event:
            case Heard(topic=topic, message=MarkSet() as heard) if topic is MARKS:
                self._admit(heard, event.fields, now_ns)
            case Heard(topic=topic, message=Digest() as digest) if topic is DIGEST:
                self._hear_digest(digest, now_ns)
            case Replied(tag=tag, message=MarkSet() as reply) if tag == _JOIN:
                if self._in_its_place(reply, event.fields):
                    self._merge(reply, measured=False)
            case Replied(tag=tag, message=MarkSet() as reply) if tag.startswith(_RESYNC):
                self._admit(reply, event.fields, now_ns)
            case AskEnded(tag=tag) if tag == _JOIN:
                self._join_ended(event, now_ns)
            case AskEnded(tag=tag) if tag.startswith(_RESYNC):
                self._asking.pop(tag.removeprefix(_RESYNC), None)
            case Asked(topic=topic, request=MarksRequest() as request) if topic is MARKS:
                self._answer(event, request)
            case LinkChanged(up=True):
                self._digest_due_ns = now_ns  # what the others missed; theirs come within digest_s
                for claim in self._claims.values():
                    claim.due_ns = now_ns
                return False
            case _:
                return False
        return True

    def tick(self, now_ns: int) -> None:
        """Publish what is due, compare the digests that have waited long enough, ask for what is missing."""
        self._merge_waiting(now_ns)
        self.publish(self.replica.tick(now_ns))
        if self._join_due_ns is not None and now_ns >= self._join_due_ns:
            self._join()
        for sender in list(self._claims):
            claim = self._claims[sender]
            if now_ns >= claim.due_ns:
                self._compare(sender, claim, now_ns)
        if self._name is not None and now_ns >= self._digest_due_ns:
            self._digest_due_ns = now_ns + self._digest_ns
            digest = Digest(author=self._name, role=self._role, held=self._held())
            self._bus.publish(DIGEST, digest, author=self._name)

    def publish(self, actions: Iterable[PublishSet]) -> None:
        """Perform what the replica decided; a keeper, too, hears of its own sets here."""
        for action in actions:
            self._put(action.mark_set)

    @property
    def throttled(self) -> list[str]:
        """Authors that mark more than their share and are heard with delay now."""
        return self._quota.throttled

    @property
    def unacknowledged(self) -> int | None:
        """How many of our own sets no keeper has committed yet in this form; None before any keeper spoke."""
        if self._kept is None or self.replica.author is None:
            return None
        return len(self.replica.ahead_of(self._kept, [self.replica.author]))

    # --- sets -----------------------------------------------------------------------------------------------

    def _put(self, mark_set: MarkSet) -> None:
        region = self.replica.grid.region_of_tile(mark_set.tile)
        self._bus.publish(MARKS, mark_set, region=region, tile=mark_set.tile, author=mark_set.author)

    def _admit(self, mark_set: MarkSet, key: Mapping[str, str], now_ns: int) -> None:
        """Merge a set now, or later if its author says too much."""
        if not self._in_its_place(mark_set, key):
            return
        if self._quota.admits(mark_set, now_ns):
            self._quota.charge(mark_set.author, self._merge(mark_set, measured=True), now_ns)
        elif now_ns - self._named_ns.get(mark_set.author, -_NAME_AGAIN_NS) >= _NAME_AGAIN_NS:
            self._named_ns[mark_set.author] = now_ns
            log.warning("author %s marks more than its share: it is heard with delay", mark_set.author)

    def _merge_waiting(self, now_ns: int) -> None:
        while (mark_set := self._quota.due(now_ns)) is not None:
            self._quota.charge(mark_set.author, self._merge(mark_set, measured=False), now_ns)
        self._quota.forget(now_ns)

    def _in_its_place(self, mark_set: MarkSet, key: Mapping[str, str]) -> bool:
        if key.get("author") == mark_set.author and key.get("tile") == str(mark_set.tile):
            return True
        self.replica.counts["sets_refused"] += 1  # access is granted by key: nobody speaks for another
        return False

    def _merge(self, mark_set: MarkSet, *, measured: bool) -> int:
        """Returns how many cells changed."""
        changed = self.replica.merge(mark_set, measured=measured)
        if changed is None:
            return 0
        if self._on_accepted is not None:
            self._on_accepted(mark_set)
        return len(changed)

    def _answer(self, asked: Asked, request: MarksRequest) -> None:
        named = asked.fields.get("author", "*")
        author = None if "*" in named else named
        if not self._serves_all:
            author = self.replica.author
        for each in self.replica.answer(request, author):
            region = self.replica.grid.region_of_tile(each.tile)
            asked.answer(each, region=region, tile=each.tile, author=each.author)
        asked.end()

    # --- late join ------------------------------------------------------------------------------------------

    def _join(self) -> None:
        self._join_due_ns = None
        self._join_tries += 1
        self._bus.ask(MARKS, MarksRequest(), self._post, tag=_JOIN, timeout_s=_JOIN_TIMEOUT_S)

    def _join_ended(self, event: AskEnded, now_ns: int) -> None:
        if (event.replies and event.failure is None) or self._join_tries >= _JOIN_TRIES:
            self.joined = True
            return
        # Nobody there, a link lost or simply nothing said yet: these look alike. Digests tell the rest later.
        self._join_due_ns = now_ns + (_RETRY_NS << (self._join_tries - 1))

    # --- digests --------------------------------------------------------------------------------------------

    def _hear_digest(self, digest: Digest, now_ns: int) -> None:
        if digest.author == self._name:
            return
        self._heard_ns[digest.author] = now_ns
        if digest.role == "keeper":
            self._kept = digest.held
        waiting = self._claims.get(digest.author)
        due_ns = now_ns + _GRACE_NS if waiting is None else min(waiting.due_ns, now_ns + _GRACE_NS)
        self._claims[digest.author] = _Claim(digest, due_ns)

    def _compare(self, sender: str, claim: _Claim, now_ns: int) -> None:
        """Ask for what they hold and we miss; give a keeper what we hold and it misses of those who are gone."""
        missing = self.replica.compare(claim.digest.held)
        throttled = self.throttled
        for author, tiles in missing:
            if author in throttled:
                continue  # what it said waits here already
            # Not only when an ask has ended: where its end was lost, that takes until its timeout.
            asked_ns = self._asking.get(author)
            again = asked_ns is not None and now_ns - asked_ns >= _RETRY_NS
            if again or (asked_ns is None and len(self._asking) < _ASKS_AT_ONCE):
                self._asking[author] = now_ns
                request = MarksRequest(authors=[author], tiles=tiles)
                self._bus.ask(MARKS, request, self._post, tag=_RESYNC + author, author=author)
        if claim.digest.role == "keeper" and not self._serves_all and claim.tries == 0:
            self._offer(claim.digest.held, now_ns)
        claim.tries += 1
        if not missing or claim.tries > 3:
            del self._claims[sender]  # the next digest tells again
        else:
            claim.due_ns = now_ns + _RETRY_NS

    def _offer(self, kept: Held, now_ns: int) -> None:
        """Put again what a keeper never got and its author, being gone, cannot say again."""
        silent = [author for author in self.replica.ledger.authors if self._silent(author, now_ns)]
        lost = self.replica.ahead_of(kept, silent)
        for mark_set in lost[:_OFFERS_AT_ONCE]:
            self._put(mark_set)
        if lost:
            log.info("gave the keeper %d sets of authors that are gone", min(len(lost), _OFFERS_AT_ONCE))

    def _silent(self, author: str, now_ns: int) -> bool:
        heard_ns = self._heard_ns.get(author, self._started_ns)
        return author != self.replica.author and now_ns - heard_ns > 3 * self._digest_ns
