"""The keeper's shell: the map on the bus, and every mark set in the store."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from itertools import islice

import msgspec

from shared_map.keeper.base_map import BaseMapServer
from shared_map.keeper.compaction import CompactionPlan, compact
from shared_map.keeper.mark_store import Keeper, KeeperStore
from shared_map.keeper.order_service import KeptOrders
from shared_map.keeper.zone_orders import free_name, rows_of, zone_sets, zones_of
from shared_map.replication.mark_sets import is_zone, standing
from shared_map.replication.replica import MapReplica
from shared_map.replication.replica_sync import MapSync
from shared_map.replication.tiles import beyond_tile
from shared_map.sightings import Sightings
from shared_map.terrain.terrain import Terrain
from swarm.bus.bus import Appeared, Asked, Bus, Disappeared, Event, Heard, Post
from swarm.clock import NS_PER_S
from swarm.config.vehicle_classes import class_numbers
from swarm.errors import StoreError
from swarm.peers import Roster
from swarm.runtime.membership import Member, MemberService
from swarm.runtime.role_setup import RoleSetup
from swarm.runtime.stats import figures
from swarm.wire.messages.map_data import MarkSet
from swarm.wire.messages.orders import ZoneOrder, Zones
from swarm.wire.messages.planning import Sighted
from swarm.wire.messages.processes import Stats
from swarm.wire.topics import SIGHTED, STATS, ZONES

log = logging.getLogger(__name__)

THROTTLED = "throttled."
"""Prefix of the gauge of an author that exceeds its quota; the gauge is there only while it does."""

_RETRY_NS = NS_PER_S
"""A disk that refused is tried again after this."""
_NOTE_AGAIN_NS = 60 * NS_PER_S
"""Interval of repeated notes about a full disk: the log stays readable. Chosen, not measured."""
_NAME_AT_MOST = 16
"""Authors that are named in gauges and events: each gauge is a line for its collector."""
_COMPACT_EVERY_NS = NS_PER_S
_COMPACT_TILES = 16
"""Compacted at once: what sets that arrive wait for is bounded."""
_MOST_FIGURES = 1 << 20
"""Figures in all `Stats` together, some 100 MB: those of 1,000 processes with 1,000 each. Beyond it those of a
newcomer are not remembered."""
_MOST_FIGURES_SENT = 1 << 15
"""Figures in the answers to one question, some 10 ms."""
_MOST_PROCESSES = 4096
"""Number of remembered `Stats`: the holder of a certificate may write under any number of ids."""


class KeeperService(MemberService):
    """A replica which writes every set to its store, publishes by its digest which sets are safe there, and replies
    for all authors, above all for dead ones.

    replica   the marks
    modules   returns True if the modules which draw zones are loaded; its first call starts loading them. None:
              they are loaded
    """

    def __init__(
        self,
        setup: RoleSetup,
        terrain: Terrain,
        bus: Bus,
        post: Post,
        store: KeeperStore,
        modules: Callable[[], bool] | None = None,
    ) -> None:
        self._can_draw = modules or (lambda: True)
        self._zones_held: list[tuple[Asked, ZoneOrder]] = []
        """Orders of zones that wait until they can be drawn."""
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post, setup.before)
        self._bus = bus
        self._post = post
        self._id = setup.id
        self._scenario = setup.scenario
        self._terrain = terrain
        self._numbers = class_numbers(setup.scenario)
        self._base_map = BaseMapServer(terrain, setup.id)
        self._store = store
        self._orders = KeptOrders(self._member, setup.id, setup.scenario, terrain, store, bus, post)
        self._stats: dict[tuple[str, str], Stats] = {}
        """(role, id) -> the newest `Stats` of every process: those of ended processes are for late subscribers."""
        self._stats_size = 0
        """Figures in all of these."""
        self._roster = Roster()
        self._keeper = Keeper()
        self.replica = MapReplica(terrain.grid)
        self._sync = MapSync(
            self.replica,
            bus,
            post,
            setup.scenario.map,
            setup.role,
            name=setup.author,
            serves_all=True,
            committed=self._keeper.committed.held,
            on_accepted=self._accepted,
            on_digest=lambda author, now_ns: self._plan.note_alive(author, now_ns),
        )
        self._compact_after_ns = int(setup.scenario.map.compact_after_s * NS_PER_S)
        self._plan = CompactionPlan(self._compact_after_ns, 0)
        self._compact_due_ns = 0
        for name in ("sets_saved", "saves_failed", "sets_folded", "sets_refused", "marks_merged", "orders_refused"):
            self.counters.count(name, 0)
        self._save_due_ns = 0
        self._sightings = Sightings(self.replica.filter)
        self._seen: dict[str, Sighted] = {}
        self._sightings_due_ns = 0
        self._noted_ns: int | None = None
        self._named: list[str] = []
        self._member.needs("the shared map", lambda: self._sync.joined)
        self._member.needs("a store that can be written", lambda: self._noted_ns is None)
        store.bind(terrain.digest, terrain.grid, list(self._numbers))
        for each in self.replica.merge(list(store.load()), measured=False).sets:
            self._keeper.restored(each)

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._base_map.start(self._bus)
        self._plan = CompactionPlan(self._compact_after_ns, now_ns, self._store.tiles_set_aside())
        self._sync.start(now_ns)
        self._bus.subscribe(SIGHTED, self._post)
        self._bus.serve(ZONES, self._post, keeper=self._id)
        self._orders.start(now_ns)
        self._bus.subscribe(STATS, self._post)
        self._bus.serve(STATS, self._post)
        self._roster.appeared(self._member.peer)
        for role in ("planner", "targets", "keeper", "monitor"):  # agents are watched for orders
            self._bus.watch_alive(self._post, role=role)
        log.info("keeper started: %d tiles in store %s", len(self.replica.held.tiles), self._store.path)

    def handle(self, event: Event, now_ns: int) -> None:
        match event:
            case Heard(message=Sighted() as sighted):
                self._sightings.receive(sighted, now_ns)
                return
            case Heard(message=Stats() as stats):
                self._receive_stats(stats)
                return
            case Asked(topic=topic) if topic is STATS:
                self._answer_stats(event)
                return
            case Appeared(peer):  # others want to know it, too
                self._roster.appeared(peer)
            case Disappeared(peer):
                self._roster.gone(peer)
        if isinstance(event, Asked) and (fault := self._orders.stale(event, now_ns)) is not None:
            self._orders.refuse(event, fault)
        elif isinstance(event, Asked) and isinstance(event.request, ZoneOrder):
            self._order_zone(event, event.request, now_ns)
        elif not (self._orders.take_order_event(event, now_ns) or self._member.on_member_event(event)):
            self._sync.on_map_event(event, now_ns)

    def tick(self, now_ns: int) -> None:
        while self._zones_held and self._can_draw():
            self._order_zone(*self._zones_held.pop(0), now_ns)
        self._sync.take_in(now_ns)
        if now_ns >= self._save_due_ns:
            self._save(now_ns)
        if now_ns >= self._compact_due_ns and not self._keeper.waiting:
            self._compact_due_ns = now_ns + _COMPACT_EVERY_NS
            self._compact(now_ns)
        if now_ns >= self._sightings_due_ns:
            self._save_sightings(now_ns)
        self._sync.tick(now_ns)
        self._orders.tick(now_ns)
        self._name_throttled(now_ns)
        for name in ("marks_merged", "sets_refused", "sets_without_room"):
            self.counters.counts[name] = self.replica.counts[name]
        self.counters.gauge("sets_waiting", float(self._keeper.waiting))
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._base_map.stop()
        self._sync.take_in(now_ns)
        self._save(now_ns)
        self._member.publish_stats(now_ns)

    def _answer_stats(self, asked: Asked) -> None:
        """Answers with the last figures of processes that have ended, as far as one tick has time for them."""
        left = _MOST_FIGURES_SENT
        for (role, id), stats in sorted(self._stats.items()):
            wanted = asked.fields["role"] in ("*", role) and asked.fields["id"] in ("*", id)
            if wanted and not self._roster.is_alive(role, id) and left > 0:
                left -= figures(stats)
                asked.answer(stats, role=role, id=id)
        asked.end()

    def _receive_stats(self, stats: Stats) -> None:
        key = (stats.role, stats.id)
        known = self._stats.get(key)
        if known is None and (len(self._stats) >= _MOST_PROCESSES or self._stats_size >= _MOST_FIGURES):
            return
        if known is None or (stats.incarnation, stats.stamp_ns) >= (known.incarnation, known.stamp_ns):
            self._stats_size += figures(stats) - (0 if known is None else figures(known))
            self._stats[key] = stats

    def _save_sightings(self, now_ns: int) -> None:
        """Saves the newest sightings, and looks whether the store is as it was left. Sightings are for people to
        look at, so a full disk is no reason to try again."""
        self._sightings_due_ns = now_ns + NS_PER_S
        best, targets = self._sightings.best(now_ns), self._orders.book.targets(self._scenario)
        new = {id: best[id] for id in best if id in targets and self._seen.get(id) != best[id]}
        self._sightings.expire(now_ns)
        self._seen.update(new)
        with suppress(StoreError):
            self._store.check()
            if new:
                self._store.save_sightings(new.values())

    def _name_throttled(self, now_ns: int) -> None:
        """Notes each author that begins to exceed its quota."""
        throttled = self._sync.throttled
        self.counters.gauge("authors_throttled", float(len(throttled)))
        for author in self._named:
            self.counters.gauges.pop(THROTTLED + author, None)
        # Those which are named stay until they wait no more: else each new name that sorts first would be one more.
        self._named = [author for author in self._named if author in throttled]
        unnamed = (author for author in throttled if author not in self._named)
        for author in islice(unnamed, _NAME_AT_MOST - len(self._named)):
            self._named.append(author)
            text = f"author {author} exceeds its quota; its marks are delayed"
            self._member.note(now_ns, "quota", text)
            self._member.alarms.begin("quota", author, text, now_ns)
        for author in self._named:
            self.counters.gauge(THROTTLED + author, 1.0)
        self._member.alarms.last_of("quota", self._named, now_ns)

    def _accepted(self, mark_set: MarkSet) -> None:
        self._keeper.accept(mark_set)
        self._plan.accepted(mark_set)

    def _order_zone(self, asked: Asked, order: ZoneOrder, now_ns: int) -> None:
        """Writes the marks of a zone: on the disk first, as an answer promises that they stay."""
        if order.action == "add" and not self._can_draw():
            self._zones_held.append((asked, order))
            return
        sets: list[MarkSet] = []
        if order.action != "list":
            if not order.name:
                order = msgspec.structs.replace(order, name=free_name(self.replica))
            found = zone_sets(order, self.replica, self._terrain, self._store.set_aside, now_ns, self._numbers)
            try:
                if isinstance(found, list):
                    sets = found
                    self._store.save(sets, now_ns)
            except StoreError as error:
                found = str(error)
            if isinstance(found, str):
                self._orders.refuse(asked, found)
                return
            self.replica.merge(sets)
            self._keeper.saved(sets)
            for each in sets:
                self._plan.accepted(each)
            self._sync.publish(sets)
            self._member.note(now_ns, "order", f"zone {order.action} {order.name}")
        zones = zones_of(self.replica, now_ns, self._numbers)
        changed = order.name if sets else ""
        asked.answer(Zones(keeper=self._id, zones=zones, changed=changed, sets=rows_of(sets)), keeper=self._id)
        asked.end()

    def _compact(self, now_ns: int) -> None:
        """Compacts the marks of dead authors, a few tiles at a time. The store is written before any set is
        published, so that it can always restore dropped marks."""
        plan = self._plan
        plan.update(self.replica.held.ledger, now_ns)
        # Measurements of a dead author stay as they are: no set overrules them.
        beyond = beyond_tile(self.replica.grid)
        tiles = [tile for tile in plan.take_due(_COMPACT_TILES, now_ns) if tile != beyond]
        compacted: list[MarkSet] = []
        try:
            for tile in tiles:
                sets = self.replica.held.of_tile(tile)
                dropped = self._store.set_aside(tile)
                ended_ns = now_ns - self._compact_after_ns
                # A zone has no process, and nothing of it may be missing from the map when one above it is removed.
                zones = {each.author: each for each in sets if is_zone(each.author)}
                stand = {name for name, each in zones.items() if len(standing(each, ended_ns).cells)}
                named = {*dropped, *(each.author for each in sets)} - stand
                gone = {name for name in named if plan.is_gone(name)}
                new = compact(sets, dropped, gone, ended_ns)
                left = {each.author: each for each in sets if each.author in gone or each.author in stand}
                plan.compacted(tile, (left | {each.author: each for each in new}).values(), now_ns)
                compacted.extend(new)
            if compacted:
                self._store.save(compacted, now_ns)
        except StoreError as error:
            plan.put_off(tiles)
            self._compact_due_ns = now_ns + 10 * _COMPACT_EVERY_NS
            log.warning("cannot compact: %s", error)
            return
        self.replica.merge(compacted, measured=False)
        self._keeper.saved(compacted)
        self._sync.publish(compacted)
        self.counters.count("sets_folded", len(compacted))

    def _save(self, now_ns: int) -> None:
        """Commits the sets that wait. If the disk refuses, reports it once, continues to serve and tries again."""
        try:
            for batch in self._keeper.batches():
                self._store.save(batch, now_ns)
                self._keeper.saved(batch)
                self.counters.count("sets_saved", len(batch))
        except StoreError as error:
            self.counters.count("saves_failed")
            self._save_due_ns = now_ns + _RETRY_NS
            if self._noted_ns is None or now_ns - self._noted_ns >= _NOTE_AGAIN_NS:
                self._noted_ns = now_ns
                text = f"{error}; {self._keeper.waiting} sets wait, serving goes on"
                log.error("%s", text)
                self._member.note(now_ns, "store", text)
                self._member.alarms.begin("keeper-behind", f"keeper-{self._id}", text, now_ns)
            return
        if self._noted_ns is not None:
            self._noted_ns = None
            log.info("the store can be written again")
            self._member.alarms.end("keeper-behind", f"keeper-{self._id}", now_ns)
            self._member.note(now_ns, "store", f"the store {self._store.path} can be written again")
