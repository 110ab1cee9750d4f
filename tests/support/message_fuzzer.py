"""Messages of every type of the wire, at random: any that decodes, made of the bounds in its type.

Tests draw them as properties (`wire_strategies`), services are lied to with them, and a live swarm is attacked.
"""

from __future__ import annotations

import contextlib
import functools
import math
import random
import typing
from collections.abc import Callable, Sequence
from enum import Enum
from types import NoneType
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from shared_map.pace_measurements import KEYS, MOST, MOST_CELLS, ONE, Measurement, columns_of
from shared_map.replication.mark_sets import packed
from shared_map.replication.tiles import beyond_tile, region_of
from swarm.clock import NS_PER_S
from swarm.config.scenario import agent_of
from swarm.config.vehicle_classes import GROUND, MOST_CLASSES
from swarm.errors import OutsideGridError, ProtocolError
from swarm.grid import GridSpec
from swarm.peers import Peer
from swarm.wire.codec import decode, encode
from swarm.wire.fields import OR_INFINITE, Bounded, Column, pack_column, taken_apart
from swarm.wire.messages import Message
from swarm.wire.messages.map_data import (
    BASE_DIGEST_BYTES,
    DIGEST_ROW,
    PACE_LEAST,
    PACE_MOST,
    BaseMap,
    MarkSet,
    MarkSets,
)
from swarm.wire.messages.planning import PushedRoute
from swarm.wire.messages.traffic import Held, Number
from swarm.wire.messages.vehicles import NO_TARGET, Followed, SharedCosts
from swarm.wire.route_columns import Route, RouteBatch, Routes
from swarm.wire.topics import Topic

NAMES = (
    "t0", "t0.r1", "t1", "a0", "a1", "a0-00", "a0-01", "all.a0.1", "a0.1", "all", "0", "agent", "keeper", "planner",
    "x" * 64,
)  # fmt: skip
ROLES = ("agent", "planner", "keeper", "targets", "monitor", "router")
_TRIES = 10_000

M = TypeVar("M")


class MessageFuzzer:
    """Makes messages from a seed: the same seed, the same messages.

    grid     messages name cells, tiles and places in it, at its end and beyond
    names    ids that are used: of those who exist, and others
    classes  of vehicles beside "ground", in the order of their numbers
    now_ns   of the clock around which messages are stamped
    """

    def __init__(
        self,
        grid: GridSpec,
        seed: int,
        names: Sequence[str] = NAMES,
        classes: Sequence[str] = (),
        now_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        self._grid = grid
        self._names = names
        self._classes = (GROUND, *classes)
        self._now_ns = now_ns
        self._authors = [name for name in names if name.count(".") == 2] or ["all.a0.1"]
        """<group>.<agent>.<generation>"""
        self._vehicles = [name for name in names if agent_of(name) != name] or ["a0-00"]
        self._chance = random.Random(seed)
        self.largest: tuple[int, ...] | None = None
        """Numbers of items in lists and maps; None for few."""
        self._left = 0
        """Items that a large message may still have."""

    def fields(self, topic: Topic, message: Message) -> dict[str, Any]:
        """The fields of the message's key: what the message says itself, the region of its tile and the agent of
        its vehicle, else any name."""
        named = {name: getattr(message, name, None) for name in topic.fields}
        if isinstance(message, MarkSet):
            with contextlib.suppress(OutsideGridError):
                named["region"] = region_of(self._grid, message.tile)
        if isinstance(message, PushedRoute | Followed):
            named["agent"] = agent_of(message.vehicle)
        return {name: self._name() if value is None else value for name, value in named.items()}

    def token(self, role: str) -> Peer:
        return Peer(role, self._name(), self._whole(0, (1 << 62) - 1))

    # --- making ---------------------------------------------------------------------------------------------

    def message(self, kind: type[M]) -> M:
        """A message of this type which decodes."""
        for _ in range(_TRIES):
            try:
                made = self._made(kind)
                return decode(encode(made), kind)  # type: ignore[type-var]
            except (ProtocolError, ValueError):
                continue  # fields that contradict each other
        raise AssertionError(f"no {kind.__name__} of {_TRIES} decodes: its types say less than its checks")

    def altered(self, message: M) -> M:
        """A message with one thing in it, at any depth, replaced, so that it decodes; itself where nothing
        in it can be."""
        for _ in range(20):
            with contextlib.suppress(ProtocolError, ValueError):
                return decode(encode(self._altered(message)), type(message))  # type: ignore[type-var]
        return message

    def _altered(self, struct: Any) -> Any:
        names = [name for name in struct.__struct_fields__ if name != "schema"]
        if not names:
            return struct
        name = self._chance.choice(names)
        hint = _hints(type(struct))[name]  # type: ignore[arg-type]
        return msgspec.structs.replace(struct, **{name: self._instead_of(getattr(struct, name), name, hint)})

    def _instead_of(self, value: Any, name: str, hint: Any) -> Any:
        rule = next((note for note in taken_apart(hint)[1] if isinstance(note, Column)), None)
        match value:
            case bytes() if rule is not None and value:
                width = len(self._column(rule, 1))
                at = width * self._chance.randrange(len(value) // width)
                return value[:at] + self._column(rule, 1) + value[at + width :]
            case Bounded():
                return self._altered(value)
            case [*_, Bounded()]:
                at = self._chance.randrange(len(value))
                return [*value[:at], self._altered(value[at]), *value[at + 1 :]]
            case _:
                return self._value(name, hint)

    def _made(self, kind: type[Any]) -> Any:
        if kind is Routes:
            return RouteBatch.of([self._made(Route) for _ in range(self._many(3))]).columns()
        if kind is Held:
            return Held.of(self._value("holds", list[Number]))
        if kind is MarkSets:
            author = self._chance.choice(self._authors)
            own = {"author": author, "group": author.partition(".")[0]}
            sets = [msgspec.structs.replace(self._made(MarkSet), **own) for _ in range(max(self._many(3), 1))]
            return next(iter(packed({each.tile: each for each in sets}.values())))
        hints = _hints(kind)  # type: ignore[arg-type]
        fields = {name: self._value(name, hint) for name, hint in hints.items() if not _per(hint)}
        for name, hint in hints.items():
            if rule := _per(hint):
                fields[name] = self._column(rule, len(fields[rule.per]))
        if {"author", "group"} <= fields.keys() and self._chance.random() < 0.7:
            fields["author"] = author = self._chance.choice(self._authors)
            fields["group"] = author.partition(".")[0]
        if kind is MarkSet:
            tells_of_ground = fields["tile"] == beyond_tile(self._grid) and self._chance.random() < 0.8
            fields |= self._learned() if tells_of_ground else self._statements()
        if kind is Route or kind is Followed:
            fields["legs"] = self._legs(len(fields["directions"]))
        if kind is BaseMap:
            regions = GridSpec(fields["rows"], fields["cols"], 1.0).regions
            fields["digests"] = {"ground": bytes(BASE_DIGEST_BYTES * regions)}
        if kind is SharedCosts:
            fields |= self._shared_costs()
        return kind(**fields)

    def _shared_costs(self) -> dict[str, Any]:
        """One agent's, about its own vehicles."""
        author = self._chance.choice(self._authors)
        group, agent, _ = author.split(".")
        ids = [f"{agent}-{n:02d}" for n in range(self._many(9))]
        target_ids = self._chance.sample(
            list(dict.fromkeys(self._names)), self._chance.choice((0, 1, min(len(set(self._names)), 5)))
        )
        costs_s = self._column(Column("<f4", least=0, most=math.inf), len(ids) * len(target_ids))
        chased = [self._chance.choice((*range(len(target_ids)), NO_TARGET)) for _ in ids]
        return {
            "author": author,
            "group": group,
            "ids": ids,
            "target_ids": target_ids,
            "costs_s": costs_s,
            "targets": bytes(chased),
        }

    def _statements(self) -> dict[str, bytes]:
        many = min(self._many(40), 1024)
        where = sorted(self._chance.sample(range(1024), many))
        paces = [self._chance.choice([PACE_LEAST, PACE_MOST, 1.0]) for _ in where]
        stamps = [self._stamp_ns(0, (1 << 62) - 1) for _ in where]
        return {
            "cells": np.array(where, "<u2").tobytes(),
            "kinds": bytes(self._chance.randrange(3) for _ in where),
            "paces": np.array(paces, "<f4").tobytes(),
            "stamps_ns": np.array(stamps, "<i8").tobytes(),
            "untils_ns": self._chance.choice([b"", np.array(stamps, "<i8").tobytes()]),
        }

    def _learned(self) -> dict[str, bytes]:
        """The word of an author about kinds of ground."""
        choice = self._chance.choice
        said = {
            choice((0, 1, self._chance.randrange(KEYS), KEYS - 1)): Measurement(
                choice((1, 30, MOST_CELLS)), choice((-MOST, 0, ONE, MOST)), choice((0, 1, ONE, MOST * MOST // ONE))
            )
            for _ in range(choice((1, 3, 40)))
        }
        columns: Sequence[np.ndarray] = columns_of(said, self._stamp_ns(0, (1 << 62) - 1))
        names = ("cells", "kinds", "paces", "stamps_ns")
        return {name: each.tobytes() for name, each in zip(names, columns, strict=True)}

    def _legs(self, steps: int) -> bytes:
        """Segments over that many steps, or none."""
        if not steps or self._chance.random() < 0.3:
            return b""
        turns = sorted(self._chance.sample(range(1, steps), self._chance.randrange(min(steps, 5))))
        return pack_column(np.diff([0, *turns, steps]), "<u4")

    def _tile(self, most: int) -> int:
        """A tile of any class of vehicles, one between those, or none."""
        last = beyond_tile(self._grid)
        number = self._chance.choice((*[*range(len(self._classes))] * 2, MOST_CLASSES, MOST_CLASSES + 1))
        told = self._grid.tile_for(self._chance.randrange(last), number)
        return self._chance.choice([*[told, last] * 3, told, self._grid.tile_for(last, number), most])

    def _stamp_ns(self, least: int, most: int) -> int:
        if self._chance.random() < 0.5:
            return self._whole(least, most)
        return min(max(self._now_ns() + int(self._chance.uniform(-20, 20) * NS_PER_S), least), most)

    def _within(self, name: str) -> float:
        """A place in the grid, in its frame by that name, in rows and columns by any other."""
        side = self._chance.randrange(max(self._grid.rows, self._grid.cols)) + 0.5
        match name:
            case "x_m":
                return self._grid.west_m + side * self._grid.resolution_m
            case "y_m":
                return self._grid.north_m - side * self._grid.resolution_m
        return side

    def _value(self, name: str, hint: Any) -> Any:
        bare, notes = taken_apart(hint)
        args = typing.get_args(bare)
        origin = typing.get_origin(bare) or bare
        metas = [note for note in notes if isinstance(note, msgspec.Meta)]
        if msgspec.UnsetType in args:
            return msgspec.UNSET if self._chance.random() < 0.3 else self._value(name, args[0])
        if NoneType in args:
            return None if self._chance.random() < 0.3 else self._value(name, args[0])
        if origin is Literal:
            return self._chance.choice(args)
        if origin is int:
            least, most = _limits(metas)
            if name in ("tile", "tiles"):
                return self._tile(most)
            if name.endswith("_ns"):
                return self._stamp_ns(least, most)
            return self._whole(least, most, cell="cell" in name or name in ("start", "held"))
        if origin is float:
            least, most = (float(limit) for limit in _limits(metas))
            inside = min(max(self._within(name), least), most)
            some = [least, 0.0 if least <= 0 else least, 5e-324 if least <= 0 else least, 1.0, min(most, 1e300)]
            some += [inside, inside]
            return self._chance.choice([*some, math.inf] if OR_INFINITE in notes else some)
        if origin is bool:
            return self._chance.random() < 0.5
        if origin is str:
            if name in ("vehicle_class", "classes") and self._chance.random() < 0.8:
                return self._chance.choice(self._classes)
            if name in ("vehicle", "vehicles", "ids") and self._chance.random() < 0.8:
                return self._chance.choice(self._vehicles)
            is_id = any(meta.pattern for meta in metas)
            return self._name() if is_id else self._chance.choice(["", "a/b", "ü" * 90, *self._names])
        if origin is bytes:
            rule = next((note for note in notes if isinstance(note, Column)), None)
            return b"" if rule is None else self._column(rule, self._many(40))
        if origin is list:
            return [self._value(name, args[0]) for _ in range(self._many(9))]
        if origin is tuple:
            return tuple(self._value(name, arg) for arg in args)
        if origin is dict:
            return {self._value(name, args[0]): self._value(name, args[1]) for _ in range(self._many(3))}
        if isinstance(origin, type) and issubclass(origin, Enum):
            return self._chance.choice(list(origin))
        return self._made(origin)

    def _column(self, rule: Column, many: int) -> bytes:
        if not isinstance(rule.dtype, str):
            rows = [
                (self._chance.randrange(9), self._whole(0, (1 << 62)), self._whole(0, 1 << 62)) for _ in range(many)
            ]
            return np.array(rows, DIGEST_ROW).tobytes()
        dtype: np.dtype[Any] = np.dtype(rule.dtype)
        if dtype.kind == "f":
            assert rule.least is not None
            assert rule.most is not None
            some = [rule.least, rule.most, max(rule.least, 0.0), 1.0]
            return np.array([self._chance.choice(some) for _ in range(many)], dtype).tobytes()
        info = np.iinfo(dtype)
        least, most = (int(rule.least or info.min), int(info.max if rule.most is None else rule.most))
        return np.array([self._whole(least, most, cell=True) for _ in range(many)], dtype).tobytes()

    def _whole(self, least: int, most: int, cell: bool = False) -> int:
        near = [self._chance.randrange(self._grid.cells), self._grid.cells - 1, self._grid.cells, 0, 1, 2]
        some = [*near, *([] if cell else [10**12, 1 << 45]), least, most, most - 1]
        return min(max(self._chance.choice(some), least), most)

    def _name(self) -> str:
        if self.largest is not None and self._chance.random() < 0.9:
            return f"{self._chance.choice(('a0', 'all.x', 'x'))}-{self._chance.randrange(1 << 40):x}"
        return self._chance.choice(self._names)

    def _many(self, most: int) -> int:
        """Number of items in a list, map or column."""
        if self.largest is None:
            return self._chance.choice((0, 1, 2, most))
        many = self._chance.choice(self.largest)
        self._left -= many
        if self._left < 0:
            raise ValueError("more items than the bound has bytes")
        return many

    def large(self, kind: type[M], most_bytes: int) -> M:
        """A message about as long as a bound on its bytes lets it be: one of several shapes, each list or map in it
        empty, short or as long as fits."""
        shape = self._chance.choice(((), (1,), (0, 1), (2, 9)))
        state, found, many = self._chance.getstate(), self.message(kind), 4
        while many <= most_bytes:
            self.largest = (*shape, many)
            self._chance.setstate(state)
            made = self._fits(kind, most_bytes)
            if made is None:
                break
            found, many = made, many * 3 // 2
        self.largest = None
        return found

    def _fits(self, kind: type[M], most_bytes: int) -> M | None:
        """A message of this type which decodes, if it has no more bytes than that."""
        self._left = most_bytes
        with contextlib.suppress(ProtocolError, ValueError):
            payload = encode(self._made(kind))
            return decode(payload, kind) if len(payload) <= most_bytes else None  # type: ignore[type-var]
        return None


@functools.cache
def _hints(kind: type[Any]) -> dict[str, Any]:
    return typing.get_type_hints(kind, include_extras=True)


def _per(hint: Any) -> Column | None:
    return next((note for note in taken_apart(hint)[1] if isinstance(note, Column) and note.per), None)


def _limits(metas: list[msgspec.Meta]) -> tuple[Any, Any]:
    least = next((meta.ge for meta in metas if meta.ge is not None), 0)
    most: Any = next((meta.le for meta in metas if meta.le is not None), None)
    if most is None:
        most = next((meta.lt - 1 for meta in metas if meta.lt is not None), 1e300)
    return least, most


def mutated(payload: bytes, chance: random.Random, others: Sequence[bytes] = ()) -> bytes:
    """A payload with a few bytes changed, put in, taken out, doubled or cut off, or spliced in from others."""
    data = bytearray(payload)
    for _ in range(chance.choice((1, 1, 1, 2, 4))):
        at, many = chance.randrange(len(data) + 1), chance.randint(1, 9)
        match chance.randrange(7):
            case 0:
                data[at : at + 1] = chance.randbytes(1)
            case 1:
                data[at : at + 1] = bytes(byte ^ 1 << chance.randrange(8) for byte in data[at : at + 1])
            case 2:
                del data[at : at + many]
            case 3:
                data[at:at] = chance.randbytes(many)
            case 4:
                data[at:at] = data[at : at + many]
            case 5:
                del data[at:]
            case 6 if others:
                other = chance.choice(others)
                start = chance.randrange(len(other))
                data[at : at + 4] = other[start : start + chance.randrange(1, 20)]
    return bytes(data)
