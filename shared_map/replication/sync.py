"""The bus side of a replica: what planner, agent, monitor and keeper services embed to take part in the map."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from shared_map.replication.digest import Held
from shared_map.replication.mark_sets import packed, unpacked
from shared_map.replication.marks import region_tiles
from shared_map.replication.quota import Quota
from shared_map.replication.replica import MapReplica, Merged, PublishSet
from swarm.bus.bus import Asked, AskEnded, Bus, Event, Heard, HeardMany, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import MapConfig
from swarm.wire.messages.base import Message
from swarm.wire.messages.marks import Digest, MarkSet, MarkSets, MarksRequest
from swarm.wire.topics import DIGEST, MARKS

log = logging.getLogger(__name__)

_JOIN = "map-join"
_ENTER = "map-enter"
_RESYNC = "map-resync:"
_JOIN_TIMEOUT_S = 5.0
_JOIN_TRIES = 5
_GRACE_NS = NS_PER_S // 10
"""A digest may overtake the sets that it tells of: only what is missing after this is asked for."""
_RETRY_NS = NS_PER_S * 15 // 100
_TELL_CHANGES_NS = NS_PER_S // 5
_RECENT_NS = 2 * NS_PER_S
_JOIN_RETRY_NS = NS_PER_S // 2
_NAME_AGAIN_NS = 60 * NS_PER_S
_ASKS_AT_ONCE = 16
_TRIES = 10
_OFFERS_AT_ONCE = 256
_QUANTUM = 16_384
"""Marks of one author that are merged before its quota is looked at again."""
_MANY = "-"
"""In place of region and tile in the key of a reply that carries many sets of an author."""
_MAX_NAMES = 4096
_MAX_CLAIM_BYTES = 64 << 20
"""What digests that wait to be compared may hold: more are dropped, and told again a second later."""


@dataclass(slots=True)
class _Claim:
    """A digest that still has to be compared with what we hold."""

    digest: Digest
    due_ns: int
    tries: int = 0

    @property
    def size(self) -> int:
        return 1000 + sum(map(len, self.digest.held.values())) + 100 * len(self.digest.held)


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
        near: bool = False,
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
        self._regions: frozenset[int] | None = frozenset() if near else None
        self._quota = Quota(config.author_marks_per_s, config.total_marks_per_s)
        self._named_ns: dict[str, int] = {}
        self._digest_ns = int(config.digest_s * NS_PER_S)
        self._digest_due_ns = 0
        self._join_due_ns: int | None = None
        self._join_tries = 0
        self._claims: dict[tuple[str, bool], _Claim] = {}  # (sender, whether it is whole)
        self._claim_bytes = 0
        self._digest_seq = 0
        self._heard_seqs: dict[tuple[str, bool], int] = {}  # of the newest digest of a sender
        self._recent: dict[int, int | None] = {}  # own tile that was put -> until when that is told of
        self._changes_due_ns = 0
        self._asking: dict[str, int] = {}  # author -> when asked for
        self._heard_ns: dict[str, int] = {}
        self._kept: Held | None = None
        self._started_ns = 0

    def start(self, now_ns: int) -> None:
        """Subscribe, serve, and ask for all that was said before."""
        self._started_ns = now_ns
        if self._regions is None:
            self._bus.subscribe(MARKS, self._post, together=True)
            self._join()
        self._bus.subscribe(DIGEST, self._post)
        if self._serves_all:
            self._bus.serve(MARKS, self._post)
        elif self.replica.author is not None:
            self._bus.serve(MARKS, self._post, author=self.replica.author)

    def look_at(self, regions: frozenset[int]) -> None:
        """Of a feed that holds only what is `near`: take part in these regions from now on. What was said there
        before is fetched, what others said elsewhere forgotten; an answer that is lost is noticed by digests."""
        before = self._regions
        if before is None or regions == before:
            return
        self._regions = regions
        new, grid = sorted(regions - before), self.replica.grid
        for region in new:
            self._bus.subscribe(MARKS, self._post, together=True, region=region)
        for region in sorted(before - regions):
            self._bus.unsubscribe(MARKS, region=region)
        self.replica.limit(regions)
        tiles = [tile for region in new for tile in region_tiles(grid, region)]
        if tiles:
            self._bus.ask(MARKS, MarksRequest(tiles=tiles, bulk=True), self._post, tag=_ENTER)

    def handle(self, event: Event, now_ns: int) -> bool:
        """True if the event was about the map and nobody else's business."""
        match event:
            case HeardMany(topic=topic, samples=samples) if topic is MARKS:
                self._hear(samples, now_ns)
            case Heard(topic=topic, message=Digest() as digest) if topic is DIGEST:
                self._hear_digest(digest, now_ns)
            case Replied(tag=tag, topic=topic) if topic is MARKS and tag in (_JOIN, _ENTER):
                self._take_in(event)
            case Replied(tag=tag, topic=topic) if topic is MARKS and tag.startswith(_RESYNC):
                match self._told(event):
                    case MarkSets() as many:
                        self._admit(unpacked(many), now_ns)
                    case MarkSet() as one:
                        self._admit([one], now_ns)
            case AskEnded(tag=tag) if tag == _ENTER:
                self.joined = True
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
        self._tell_digest(now_ns)

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
        if mark_set.author == self.replica.author:
            self._recent.setdefault(mark_set.tile, None)
        region = self.replica.grid.region_of_tile(mark_set.tile)
        self._bus.publish(MARKS, mark_set, region=region, tile=mark_set.tile, author=mark_set.author)

    def _hear(self, samples: Sequence[tuple[str, Message]], now_ns: int) -> None:
        """Sets that were put: each under the key of its tile and author, as access is granted by key."""
        if len(samples) == 1:
            self._hear_one(*samples[0], now_ns)
            return
        sets = [
            each for key, each in samples
            if isinstance(each, MarkSet) and key.endswith(f"/{each.tile}/{each.author}")
        ]  # fmt: skip
        self.replica.counts["sets_refused"] += len(samples) - len(sets)
        self._admit(sets, now_ns)

    def _hear_one(self, key: str, heard: Message, now_ns: int) -> None:
        """As `_hear`, without what only many need: somebody may wait for this one."""
        if not isinstance(heard, MarkSet) or not key.endswith(f"/{heard.tile}/{heard.author}"):
            self.replica.counts["sets_refused"] += 1
        elif not self._quota.admits(heard, now_ns):
            self._name_late(heard.author, now_ns)
        else:
            changed = self.replica.merge(heard)
            if changed is not None and self._on_accepted is not None:
                self._on_accepted(heard)
            self._quota.charge(heard.author, 0 if changed is None else len(changed), now_ns)
            self._name_crowded_out(now_ns)

    def _told(self, event: Replied) -> MarkSet | MarkSets | None:
        """What a reply says. Nobody speaks for another there either, whether of one tile or of many."""
        message = event.message
        if isinstance(message, MarkSet | MarkSets) and event.fields.get("author") == message.author:
            tile = str(message.tile) if isinstance(message, MarkSet) else _MANY
            if event.fields.get("tile") == tile:
                return message
        self.replica.counts["sets_refused"] += 1
        return None

    def _take_in(self, event: Replied) -> None:
        """Sets of a late join, or of where our interest turned to: what was said before, so at once."""
        match self._told(event):
            case MarkSets() as many:
                self._note_accepted(self.replica.merge_bulk(many, measured=False))
            case MarkSet() as one:
                self._merge([one], measured=False)

    def _admit(self, sets: Sequence[MarkSet], now_ns: int) -> None:
        """Merge sets now, or later if their author says too much."""
        taken: list[MarkSet] = []
        marks: dict[str, int] = {}  # author -> statements among those taken
        for each in sets:
            author = each.author
            said = marks.get(author)
            if said is not None and said > _QUANTUM:
                self._merge_charged(taken, marks, now_ns)
                taken, marks, said = [], {}, None
            if said is None and not self._quota.admits(each, now_ns):
                self._name_late(author, now_ns)
                continue
            taken.append(each)
            marks[author] = (said or 0) + len(each.kinds)
        self._merge_charged(taken, marks, now_ns)

    def _merge_charged(self, sets: Sequence[MarkSet], authors: Iterable[str], now_ns: int) -> None:
        costs = dict.fromkeys(authors, 0)
        merged = self._merge(sets, measured=True)
        for each, changed in zip(merged.sets, merged.changed, strict=True):
            costs[each.author] += changed
        for author, cost in costs.items():
            self._quota.charge(author, cost, now_ns)
        self._name_crowded_out(now_ns)

    def _merge_waiting(self, now_ns: int) -> None:
        while (mark_set := self._quota.due(now_ns)) is not None:
            merged = self._merge([mark_set], measured=False)
            self._quota.charge(mark_set.author, sum(merged.changed), now_ns)
        self._quota.forget(now_ns)

    def _merge(self, sets: Sequence[MarkSet], *, measured: bool) -> Merged:
        return self._note_accepted(self.replica.merge_many(sets, measured=measured))

    def _note_accepted(self, merged: Merged) -> Merged:
        if self._on_accepted is not None:
            for each in merged.sets:
                self._on_accepted(each)
        return merged

    def _name_late(self, author: str, now_ns: int) -> None:
        self._name_once(author, "marks more than its share: it is heard with delay", now_ns)

    def _name_crowded_out(self, now_ns: int) -> None:
        if self.replica.crowded_out is not None:
            self._name_once(self.replica.crowded_out, "says more than there is room for: it is not heard", now_ns)
            self.replica.crowded_out = None

    def _name_once(self, author: str, what: str, now_ns: int) -> None:
        if now_ns - self._named_ns.get(author, -_NAME_AGAIN_NS) >= _NAME_AGAIN_NS:
            if len(self._named_ns) >= _MAX_NAMES:
                self._named_ns.clear()
            self._named_ns[author] = now_ns
            log.warning("author %s %s", author, what)

    def _answer(self, asked: Asked, request: MarksRequest) -> None:
        named = asked.fields.get("author", "*")
        author = None if "*" in named else named
        if not self._serves_all:
            author = self.replica.author
        sets = self.replica.answer(request, author)
        if request.bulk:
            for many in packed(sets):
                asked.answer(many, region=_MANY, tile=_MANY, author=many.author)
        else:
            for each in sets:
                region = self.replica.grid.region_of_tile(each.tile)
                asked.answer(each, region=region, tile=each.tile, author=each.author)
        asked.end()

    # --- late join ------------------------------------------------------------------------------------------

    def _join(self) -> None:
        self._join_due_ns = None
        self._join_tries += 1
        self._bus.ask(MARKS, MarksRequest(bulk=True), self._post, tag=_JOIN, timeout_s=_JOIN_TIMEOUT_S)

    def _join_ended(self, event: AskEnded, now_ns: int) -> None:
        if (event.replies and event.failure is None) or self._join_tries >= _JOIN_TRIES:
            self.joined = True
            return
        # Nobody there, a link lost or simply nothing said yet: these look alike. Digests tell the rest later.
        self._join_due_ns = now_ns + (_JOIN_RETRY_NS << (self._join_tries - 1))

    # --- digests --------------------------------------------------------------------------------------------

    def _hear_digest(self, digest: Digest, now_ns: int) -> None:
        if digest.author == self._name:
            return
        sender = (digest.author, digest.whole)
        if digest.seq:
            if digest.seq <= self._heard_seqs.get(sender, 0):
                return  # it was overtaken on its way
            if sender in self._heard_seqs or len(self._heard_seqs) < _MAX_NAMES:
                self._heard_seqs[sender] = digest.seq
        if digest.author in self._heard_ns or len(self._heard_ns) < _MAX_NAMES:
            self._heard_ns[digest.author] = now_ns
        if digest.role == "keeper" and digest.whole:
            self._kept = digest.held
        waiting = self._claims.pop(sender, None)
        if waiting is not None:
            self._claim_bytes -= waiting.size
        due_ns = now_ns + _GRACE_NS if waiting is None else min(waiting.due_ns, now_ns + _GRACE_NS)
        claim = _Claim(digest, due_ns)
        if self._claim_bytes + claim.size <= _MAX_CLAIM_BYTES and len(self._claims) < _MAX_NAMES:
            self._claims[sender] = claim
            self._claim_bytes += claim.size

    def _tell_digest(self, now_ns: int) -> None:
        """All that we hold every `digest_s`; in between, what we changed lately: of a set that is lost on its way
        that is how the others learn within a fraction of a second."""
        if self._name is None:
            return
        if now_ns >= self._digest_due_ns:
            self._digest_due_ns = now_ns + self._digest_ns
            held, whole = self._held(), True
        else:
            author = self.replica.author
            if author is None or not self._recent or now_ns < self._changes_due_ns:
                return
            held, whole = {author: self.replica.ledger.rows_of(author, self._recent)}, False
        self._changes_due_ns = now_ns + _TELL_CHANGES_NS
        for tile, until_ns in list(self._recent.items()):
            if until_ns is None:
                self._recent[tile] = now_ns + _RECENT_NS
            elif now_ns >= until_ns:
                del self._recent[tile]
        self._digest_seq += 1
        digest = Digest(author=self._name, role=self._role, held=held, whole=whole, seq=self._digest_seq)
        self._bus.publish(DIGEST, digest, author=self._name)

    def _compare(self, sender: tuple[str, bool], claim: _Claim, now_ns: int) -> None:
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
                request = MarksRequest(authors=[author], tiles=tiles, bulk=True)
                self._bus.ask(MARKS, request, self._post, tag=_RESYNC + author, author=author)
        if claim.digest.role == "keeper" and claim.digest.whole and not self._serves_all and claim.tries == 0:
            self._offer(claim.digest.held, now_ns)
        claim.tries += 1
        if not missing or claim.tries > _TRIES:
            self._claim_bytes -= claim.size
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
