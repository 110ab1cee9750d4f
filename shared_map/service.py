"""The keeper's shell: the map on the bus, and every set of it in the store."""

from __future__ import annotations

import logging

from shared_map.base_map_bus import BaseMapServer
from shared_map.feed import MapFeed
from shared_map.keeper import Keeper, KeeperStore
from shared_map.replica import MapReplica
from shared_map.terrain import Terrain
from swarm.bus import Bus, Event, Post
from swarm.clock import NS_PER_S
from swarm.errors import StoreError
from swarm.membership import Member
from swarm.role import RoleSetup

log = logging.getLogger(__name__)

_RETRY_NS = NS_PER_S
_NOTE_AGAIN_NS = 60 * NS_PER_S


class KeeperService:
    """A replica that writes every set to its store, tells by its digest what is safe there, and answers for all
    authors, above all for those that are gone."""

    def __init__(self, setup: RoleSetup, terrain: Terrain, bus: Bus, post: Post, store: KeeperStore) -> None:
        self._member = Member(setup.info(terrain.grid, terrain.digest), bus, post)
        self.counters = self._member.counters
        self._bus = bus
        self._base_map = BaseMapServer(terrain, setup.id)
        self._store = store
        self._keeper = Keeper()
        self.replica = MapReplica(terrain.grid)
        self._feed = MapFeed(
            self.replica,
            bus,
            post,
            setup.scenario.map,
            setup.role,
            name=setup.author,
            serves_all=True,
            held=self._keeper.committed.held,
            on_accepted=self._keeper.accept,
        )
        for name in ("sets_saved", "saves_failed", "sets_refused", "marks_merged"):
            self.counters.count(name, 0)
        self._save_due_ns = 0
        self._noted_ns: int | None = None
        self._named: list[str] = []
        store.bind(terrain.digest, terrain.grid)
        for mark_set in store.load():
            if self.replica.merge(mark_set, measured=False) is not None:
                self._keeper.restored(mark_set)

    def start(self, now_ns: int) -> None:
        self._member.join()
        self._base_map.start(self._bus)
        self._feed.start(now_ns)
        log.info("keeper started: %d tiles in store %s", len(self.replica.tiles), self._store.path)

    def handle(self, event: Event, now_ns: int) -> None:
        if not self._member.handle(event):
            self._feed.handle(event, now_ns)

    def tick(self, now_ns: int) -> None:
        if now_ns >= self._save_due_ns:
            self._save(now_ns)
        self._feed.tick(now_ns)
        self._name_throttled(now_ns)
        counts = self.replica.counts
        self.counters.counts["marks_merged"] = counts["marks_merged"]
        self.counters.counts["sets_refused"] = counts["sets_refused"]
        self.counters.gauge("sets_waiting", float(len(self._keeper.waiting)))
        self._member.tick(now_ns)

    def stop(self, now_ns: int) -> None:
        self._save(now_ns)
        self._member.publish_stats(now_ns)

    def _name_throttled(self, now_ns: int) -> None:
        """Tell people once who marks more than its share."""
        throttled = self._feed.throttled
        self.counters.gauge("authors_throttled", float(len(throttled)))
        for author in throttled:
            if author not in self._named:
                self._named.append(author)
                text = f"author {author} marks more than its share: it is heard with delay"
                self._member.note(now_ns, "quota", text)
        self._named = [author for author in self._named if author in throttled]

    def _save(self, now_ns: int) -> None:
        """Commit what waits. A disk that refuses is told of, tried again, and no reason to stop serving."""
        waiting = self._keeper.waiting
        if not waiting:
            return
        try:
            self._store.save(waiting)
        except StoreError as error:
            self.counters.count("saves_failed")
            self._save_due_ns = now_ns + _RETRY_NS
            if self._noted_ns is None or now_ns - self._noted_ns >= _NOTE_AGAIN_NS:
                self._noted_ns = now_ns
                log.error("%s; %d sets wait, serving goes on", error, len(waiting))
                self._member.note(now_ns, "store", f"{error}; {len(waiting)} sets wait, serving goes on")
            return
        if self._noted_ns is not None:
            self._noted_ns = None
            log.info("the store can be written again")
            self._member.note(now_ns, "store", f"the store {self._store.path} can be written again")
        self._keeper.saved(waiting)
        self.counters.count("sets_saved", len(waiting))
