"""Anti-entropy over the bus: keeps a replica equal to all others. Every service with a replica contains one.

Sets are published when they change. A process that starts asks for all of them (late join). After that every
replica tells by digests what it holds, and a replica that misses something asks its author and the keepers for it.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence

from msgspec.structs import replace

from shared_map.replication.author_limits import Quota
from shared_map.replication.digest import PendingDigest, PendingDigests, Place, parts_of
from shared_map.replication.interest import DigestInterest
from shared_map.replication.mark_sets import packed, unpacked
from shared_map.replication.replica import MapReplica, Merged
from shared_map.replication.tiles import beyond_region, beyond_tile, of_all_classes, region_of, region_tiles
from swarm.bus.bus import Asked, AskEnded, Bus, Event, LinkChanged, Post, Replied
from swarm.clock import NS_PER_S
from swarm.config.scenario import MapConfig
from swarm.wire.messages import map_data
from swarm.wire.topics import DIGEST, MARKS

log = logging.getLogger(__name__)

_JOIN = "map-join"
_ENTER = "map-enter"
_RESYNC = "map-resync:"
"""Tags of queries: all sets, sets of regions that we enter, and sets that a digest showed to be missing."""
_JOIN_TIMEOUT_S = 5.0
"""Time for the answers of all replicas to a process that joins. Chosen, not measured."""
_JOIN_TRIES = 5
"""Questions before a process begins with what it has: the others may start with it, or there are none."""
_JOIN_RETRY_NS = NS_PER_S // 2
"""After the first try, and twice as long after each: 7.5 s in all, in which the others of a swarm have started."""
_ASK_AGAIN_NS = NS_PER_S * 15 // 100
"""A question whose answer is lost on a network that loses 30 % is repeated so soon."""
_MAX_ASKS = 16
"""Limit of authors that are asked together: the most that a false digest with thousands of rows can start."""
_CHANGES_EVERY_NS = NS_PER_S // 2
_CHANGES_FOR_NS = 2 * NS_PER_S
"""A set that was put is named in digests of changes so often and for this time: of some four, one arrives."""
_OFFERS_AT_ONCE = 256
"""Sets given to keepers in a period of digests; the next ones show what they still lack."""
_COMPARISONS_PER_TICK = 1024
"""Authors whose sets are compared for offers in one tick, some 15 ms: names cost a sender nothing."""
_TILES_AT_ONCE = map_data.MOST_TILES_ASKED
"""Named in one question: the tiles of a large map are more than a message has room for."""
_ANSWERS_PER_TICK, _TURN = 8192, 1024
"""Sets and tiles looked at for answers in one tick, some 10 ms, and for one asker before another has its turn."""
_LEAST_COST, _SINGLE_COST = 32, 16
"""Cost of a question, and of a set that is sent by itself, in sets that are sent together."""
_MOST_ANSWERS = 1024
"""Questions for sets that wait: of all agents that start at once."""
_PART_BYTES = map_data.MOST_DIGEST_BYTES - 512
"""Rows and names of authors in one digest, without its other fields."""
_QUANTUM = 16_384
"""Statements of one author that are merged before its quota is looked at again."""
_MANY = "-"
"""In place of region and tile in the key of a reply that carries many sets of an author."""
_MAX_NAMES = 4096
"""Authors of whom is remembered when they spoke or were warned of: names cost a sender nothing."""
_WARN_AGAIN_NS = 60 * NS_PER_S
"""An author is named once a minute: one that floods must not fill the log as well."""


class MapSync:
    """Keeps a replica equal to the others.

    The owning service calls `on_map_event` and `tick` before its own work, and `publish` with the result of
    `replica.write`. A replica with an author answers requests for its own sets and announces them in digests. A
    keeper answers for all sets and announces the sets that it has written to disk.

    name         sender of digests; default: the replica's author; without one no digests are sent
    serves_all   answer for all authors
    committed    function that returns the contents of a full digest; default: the digest of the replica's own sets
    on_accepted  called with every set that is merged
    on_digest    called with the author of every received digest, and the time of its arrival
    near         hold only regions that `enter` names, instead of the whole map, and hear only the digests that
                 can matter there (`DigestInterest`)
    joined       True once the initial request for existing marks is over: a reply came, or all attempts failed
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
        committed: Callable[[], dict[str, bytes]] | None = None,
        on_accepted: Callable[[map_data.MarkSet], None] = lambda mark_set: None,
        on_digest: Callable[[str, int], None] = lambda author, now_ns: None,
        near: bool = False,
    ) -> None:
        self.replica = replica
        self.joined = False
        self._bus = bus
        self._post = post
        self._role = role
        self._name = name or replica.author
        self._serves_all = serves_all
        self._committed = committed or replica.own_digest
        self._on_accepted = on_accepted
        self._on_digest = on_digest
        self._regions: frozenset[int] | None = frozenset() if near else None
        self._quota = Quota(config.author_marks_per_s, config.total_marks_per_s)
        self._warned_ns: dict[str, int] = {}  # author -> when a warning named it last
        self._join_due_ns: int | None = None  # ask again then
        self._join_tries = 0
        self._digest_ns = int(config.digest_s * NS_PER_S)
        self._digest_due_ns = 0
        self._changes_due_ns = 0
        self._digest_seq = 0
        # Parts of the whole digest that are not published yet, as `parts_of` gives them.
        # Questions for sets: each with whether sets may come together, and the sets to come.
        self._answers: deque[tuple[Asked, bool, Iterator[map_data.MarkSet | None]]] = deque()
        self._answers_left = _ANSWERS_PER_TICK
        self._parts: deque[tuple[dict[str, bytes], Place | None, Place | None]] = deque()
        self._offers_left = self._offers_due_ns = 0  # sets that may still be given until then
        self._comparisons_left = self._offer_place = 0  # authors to compare in this tick; the place of the next
        # Own tile put lately -> digests of changes name it until then; None: it has not been named yet.
        self._changed: dict[int, int | None] = {}
        self._digests = PendingDigests()
        # Senders of digests that are of interest, and to which we subscribe: None for all.
        self._digest_interest = DigestInterest(self._name or "", self._digest_ns, near=near)
        self._listened_to: frozenset[str] | None = None
        self._asked_ns: dict[str, int] = {}  # author -> when its missing sets were asked for, until the ask ends
        self._received_ns: dict[str, int] = {}  # sender -> when its last digest came

    def start(self, now_ns: int) -> None:
        """Subscribes, serves, and requests all earlier statements."""
        if self._regions is None:
            self._bus.collect(MARKS)
            self._join()
        self._bus.collect(DIGEST)
        self._digest_interest.start(now_ns)
        if self._serves_all:
            self._bus.serve(MARKS, self._post)
        elif self.replica.author is not None:
            self._bus.serve(MARKS, self._post, author=self.replica.author)

    def enter(self, regions: frozenset[int]) -> None:
        """Holds these regions from now on, if this replica holds only its vicinity: fetches marks in the new ones,
        and drops those elsewhere. Digests show if an answer is lost."""
        before = self._regions
        if before is None or regions == before:
            return
        self._regions = regions
        new, grid = sorted(regions - before), self.replica.grid
        if not before:
            self._bus.collect(MARKS, region=beyond_region(grid))
        for region in new:
            self._bus.collect(MARKS, region=region)
        for region in sorted(before - regions):
            self._bus.unsubscribe(MARKS, region=region)
        self.replica.limit_to(regions)
        tiles = of_all_classes(grid, [tile for region in new for tile in region_tiles(grid, region)])
        if not before:
            tiles.append(beyond_tile(grid))
        for first in range(0, len(tiles), _TILES_AT_ONCE):
            request = map_data.MarksRequest(tiles=tiles[first : first + _TILES_AT_ONCE], bulk=True)
            self._bus.ask(MARKS, request, self._post, tag=_ENTER)

    def on_map_event(self, event: Event, now_ns: int) -> bool:
        """True if the event concerns the map only, so that no other part needs to handle it."""
        match event:
            case Replied(tag=tag, topic=topic) if topic is MARKS and tag in (_JOIN, _ENTER):
                self._merge(self._sets_in(event), measured=False)
            case Replied(tag=tag, topic=topic) if topic is MARKS and tag.startswith(_RESYNC):
                self._admit(self._sets_in(event), now_ns)
            case AskEnded(tag=tag) if tag == _ENTER:
                self.joined = True
            case AskEnded(tag=tag) if tag == _JOIN:
                self._join_ended(event, now_ns)
            case AskEnded(tag=tag) if tag.startswith(_RESYNC):
                self._asked_ns.pop(tag.removeprefix(_RESYNC), None)
            case Asked(topic=topic, request=map_data.MarksRequest() as request) if topic is MARKS:
                self._answer(event, request)
            case LinkChanged(up=True):
                self._digest_due_ns = now_ns  # what the others missed; theirs come within digest_s
                self._digests.hasten(now_ns)
                self._digest_interest.listen_to_all(now_ns)
                return False
            case _:
                return False
        return True

    def tick(self, now_ns: int) -> None:
        """Publishes what is due, compares the digests that have waited long enough, and requests missing sets."""
        for digest in self._bus.collected(DIGEST):
            assert isinstance(digest.message, map_data.Digest)
            self._on_digest(digest.message.author, now_ns)
            self._receive_digest(digest.message, now_ns)
        self._answers_left = _ANSWERS_PER_TICK
        self._answer_some()
        self.take_in(now_ns)
        self._merge_waiting(now_ns)
        self._choose_digests(now_ns)
        self.publish(self.replica.tick(now_ns))
        if self._join_due_ns is not None and now_ns >= self._join_due_ns:
            self._join()
        self._comparisons_left = _COMPARISONS_PER_TICK
        for pending in self._digests.due(now_ns):
            self._compare(pending, now_ns)
        self._send_digest(now_ns)

    def publish(self, actions: Iterable[map_data.MarkSet]) -> None:
        """Puts the sets that the replica decided to publish."""
        for action in actions:
            self._put(action)

    def holds(self, author: str, rows: bytes, now_ns: int) -> bool:
        """Returns True if the map has the sets that these rows of a digest name, as far as they are of interest
        here and have not expired by our clock. Missing sets are requested."""
        self.take_in(now_ns)
        lacking = self.replica.lacking(author, rows)
        if lacking:
            self._fetch(author, lacking, now_ns)
        return not lacking and not self.replica.has_ended(author)

    @property
    def throttled(self) -> list[str]:
        """Processes that exceed their quota, whose marks are delayed now."""
        return self._quota.throttled

    # --- sets -----------------------------------------------------------------------------------------------

    def _put(self, mark_set: map_data.MarkSet) -> None:
        if mark_set.author == self.replica.author:
            self._changed.setdefault(mark_set.tile, None)
        region = region_of(self.replica.grid, mark_set.tile)
        self._bus.publish(MARKS, mark_set, region=region, tile=mark_set.tile, author=mark_set.author)

    def take_in(self, now_ns: int) -> None:
        """Merges what others put since the last tick, each set under the key of its tile and author: access is
        granted by key."""
        samples = self._bus.collected_together(MARKS)
        if not samples:
            return
        sets = [
            each for key, each in samples
            if isinstance(each, map_data.MarkSet) and key.endswith(f"/{each.tile}/{each.author}")
        ]  # fmt: skip
        self.replica.counts["sets_refused"] += len(samples) - len(sets)
        self._admit(sets, now_ns)

    def _sets_in(self, event: Replied) -> list[map_data.MarkSet]:
        """The sets in a reply; none if its key names another author or tile."""
        match event.message:
            case map_data.MarkSets(author=author) as many if event.fields.get("tile") == _MANY:
                sets = unpacked(many)
            case map_data.MarkSet(author=author, tile=tile) as one if event.fields.get("tile") == str(tile):
                sets = [one]
            case _:
                author, sets = "", []
        if event.fields.get("author") != author:
            self.replica.counts["sets_refused"] += 1
            return []
        return sets

    def _admit(self, sets: Sequence[map_data.MarkSet], now_ns: int) -> None:
        """Merges sets now; sets of authors that exceed their quota wait."""
        taken: list[map_data.MarkSet] = []
        marks: dict[str, int] = {}  # author -> number of its statements that are taken
        for each in sets:
            author = each.author
            stated = marks.get(author)
            if stated is not None and stated > _QUANTUM:
                self._merge_charged(taken, marks, now_ns)
                taken, marks, stated = [], {}, None
            if stated is None and not self._quota.admits(each, now_ns):
                self._warn_once(map_data.owner_of(author), "exceeds its quota; its marks are delayed", now_ns)
                continue
            taken.append(each)
            marks[author] = (stated or 0) + len(each.kinds)
        self._merge_charged(taken, marks, now_ns)

    def _merge_charged(self, sets: Sequence[map_data.MarkSet], authors: Iterable[str], now_ns: int) -> None:
        costs = dict.fromkeys(authors, 0)
        merged = self._merge(sets, measured=True)
        for author in {each.author for each in merged.sets} - {self.replica.author}:
            self._digest_interest.author_is_near(author, now_ns)
        for each, changed in zip(merged.sets, merged.changed, strict=True):
            costs[each.author] += changed
        for author, cost in costs.items():
            self._quota.charge(author, cost, now_ns)
        if self.replica.over_capacity is not None:
            self._warn_once(
                self.replica.over_capacity, "exceeds the mark capacity; its new sets are rejected", now_ns
            )
            self.replica.over_capacity = None

    def _merge_waiting(self, now_ns: int) -> None:
        for mark_set in self._quota.due(now_ns):
            merged = self._merge([mark_set], measured=False)
            self._quota.charge(mark_set.author, sum(merged.changed), now_ns)
        self._quota.forget(now_ns)

    def _merge(self, sets: Sequence[map_data.MarkSet], *, measured: bool) -> Merged:
        merged = self.replica.merge(sets, measured=measured)
        for each in merged.sets:
            self._on_accepted(each)
        return merged

    def _warn_once(self, author: str, what: str, now_ns: int) -> None:
        if now_ns - self._warned_ns.get(author, -_WARN_AGAIN_NS) >= _WARN_AGAIN_NS:
            if len(self._warned_ns) >= _MAX_NAMES:
                self._warned_ns.clear()
            self._warned_ns[author] = now_ns
            log.warning("author %s %s", author, what)

    def _answer(self, asked: Asked, request: map_data.MarksRequest) -> None:
        named = asked.fields.get("author", "*")
        author = None if "*" in named else named
        if not self._serves_all:
            author = self.replica.author
        if len(self._answers) >= _MOST_ANSWERS:
            asked.refuse(f"{MARKS.name}: too many questions wait")
            asked.end()
            return
        self._answers.append((asked, request.bulk, self.replica.held.asked(request, author)))
        self._answer_some()

    def _answer_some(self) -> None:
        """Answers queries for sets, by turns, until the work of this tick is done."""
        while self._answers and self._answers_left > 0:
            asked, bulk, found = self._answers.popleft()
            sets: list[map_data.MarkSet] = []
            cost = _LEAST_COST
            for each in () if asked.expired else found:
                if each is not None:
                    sets.append(each)
                cost += _SINGLE_COST if each is not None and not bulk else 1
                if cost >= _TURN:
                    self._answers.append((asked, bulk, found))
                    break
            self._answers_left -= cost
            for many in packed(sets) if bulk else ():
                asked.answer(many, region=_MANY, tile=_MANY, author=many.author)
            for each in () if bulk else sets:
                region = region_of(self.replica.grid, each.tile)
                asked.answer(each, region=region, tile=each.tile, author=each.author)
            if cost < _TURN:
                asked.end()

    # --- late join ------------------------------------------------------------------------------------------

    def _join(self) -> None:
        self._join_due_ns = None
        self._join_tries += 1
        self._bus.ask(MARKS, map_data.MarksRequest(bulk=True), self._post, tag=_JOIN, timeout_s=_JOIN_TIMEOUT_S)

    def _join_ended(self, event: AskEnded, now_ns: int) -> None:
        if (event.replies and event.failure is None) or self._join_tries >= _JOIN_TRIES:
            self.joined = True
            return
        # No process there, a lost link and an empty map look alike. Digests show later what this missed.
        self._join_due_ns = now_ns + (_JOIN_RETRY_NS << (self._join_tries - 1))

    # --- digests --------------------------------------------------------------------------------------------

    def _receive_digest(self, digest: map_data.Digest, now_ns: int) -> None:
        if not map_data.is_keeper(digest.author):  # names its own sets only
            held = {digest.author: rows} if (rows := digest.held.get(digest.author)) else {}
            digest = replace(digest, held=held)
        if digest.author == self._name or not self._digests.add(digest, now_ns):
            return
        if digest.author in self._received_ns or len(self._received_ns) < _MAX_NAMES:
            self._received_ns[digest.author] = now_ns
        if map_data.is_keeper(digest.author) and digest.complete:
            self._digest_interest.keeper_spoke(digest.author, now_ns)

    def _choose_digests(self, now_ns: int) -> None:
        """Receives digests of authors which may make statements about regions that we hold."""
        before, chosen = self._listened_to, self._digest_interest.update(now_ns)
        if chosen == before:
            return
        self._listened_to = chosen
        if chosen is None:
            self._bus.collect(DIGEST)
        for author in sorted((chosen or frozenset()) - (before or frozenset())):
            self._bus.collect(DIGEST, author=author)
        if before is None:
            self._bus.unsubscribe(DIGEST)
        for author in sorted((before or frozenset()) - (chosen or frozenset())):
            self._bus.unsubscribe(DIGEST, author=author)

    def _send_digest(self, now_ns: int) -> None:
        """Reports all that we hold every `digest_s`, and in between what we changed lately: so others notice a lost
        set within a fraction of a second."""
        if self._name is None:
            return
        if now_ns >= self._digest_due_ns and not self._parts:
            self._digest_due_ns = now_ns + self._digest_ns
            self._parts.extend(parts_of(self._committed(), _PART_BYTES))
        author = self.replica.author
        after: Place | None = None
        until: Place | None = None
        whole = False
        if self._parts:  # one message at a tick, as a reader takes the newest of each key
            held, after, until = self._parts.popleft()
            whole = after is None and until is None
        elif author is not None and self._changed and now_ns >= self._changes_due_ns:
            changes = {author: self.replica.held.ledger.rows_of(author, self._changed)}
            held = next(parts_of(changes, _PART_BYTES))[0]
        else:
            return
        self._changes_due_ns = now_ns + _CHANGES_EVERY_NS
        for tile, until_ns in list(self._changed.items()):
            if until_ns is None:
                self._changed[tile] = now_ns + _CHANGES_FOR_NS
            elif now_ns >= until_ns:
                del self._changed[tile]
        self._digest_seq += 1
        digest = map_data.Digest(
            author=self._name,
            role=self._role,
            held=held,
            whole=whole,
            seq=self._digest_seq,
            after=after,
            until=until,
        )
        self._bus.publish(DIGEST, digest, author=self._name)

    def _compare(self, pending: PendingDigest, now_ns: int) -> None:
        """Requests the sets that the sender holds and we lack; gives keepers the sets of dead authors that they
        lack."""
        digest = pending.digest
        missing = self.replica.missing(digest.held)
        for author, tiles in missing:
            if map_data.owner_of(author) not in self._quota.waiting:  # else its sets wait here already
                self._fetch(author, tiles, now_ns)
        if map_data.is_keeper(digest.author) and digest.complete and not self._serves_all and pending.tries == 0:
            self._offer(digest, now_ns)
        self._digests.compared(pending, not missing, now_ns)

    def _fetch(self, author: str, tiles: list[int], now_ns: int) -> None:
        """Asks for an author's sets, unless they were asked for just now."""
        # Not only when an ask has ended: if its end is lost, it ends by timeout, seconds later.
        asked_ns = self._asked_ns.get(author)
        again = asked_ns is not None and now_ns - asked_ns >= _ASK_AGAIN_NS
        if again or (asked_ns is None and len(self._asked_ns) < _MAX_ASKS):
            self._asked_ns[author] = now_ns
            request = map_data.MarksRequest(authors=[author], tiles=tiles[:_TILES_AT_ONCE], bulk=True)
            self._bus.ask(MARKS, request, self._post, tag=_RESYNC + author, author=author)

    def _offer(self, kept: map_data.Digest, now_ns: int) -> None:
        """Puts again what a keeper never got, and its author, being gone, cannot put again."""
        if now_ns >= self._offers_due_ns:
            self._offers_left, self._offers_due_ns = _OFFERS_AT_ONCE, now_ns + self._digest_ns
        silent = self._next_silent(now_ns)
        lost = self.replica.held.ahead_of(kept.held, silent, kept.after, kept.until)[: self._offers_left]
        self._offers_left -= len(lost)
        for mark_set in lost:
            self._put(mark_set)
        if lost:
            log.info("gave the keeper %d sets of authors that are gone", len(lost))

    def _next_silent(self, now_ns: int) -> list[str]:
        """Dead authors, for one digest: all, or as many as this tick allows; the next digest continues there."""
        most = self._comparisons_left if self._offers_left else 0
        authors = self.replica.held.ledger.authors_from(self._offer_place, most)
        self._comparisons_left -= len(authors)
        self._offer_place = 0 if len(authors) < most else self._offer_place + most
        return [author for author in authors if self._silent(author, now_ns)]

    def _silent(self, author: str, now_ns: int) -> bool:
        since_ns = self._digest_interest.since_ns(author)
        if since_ns is None:
            return False  # it may speak, we do not listen
        received_ns = max(self._received_ns.get(author, since_ns), since_ns)
        return author != self.replica.author and now_ns - received_ns > 3 * self._digest_ns
