"""Files of zones with any damage: all features close their ground, or the file is refused by name."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from support.effort import few
from support.zone_shapes import UTM, feature, geojson, painted

from shared_map.importers.zones.outlines import outlines_of
from swarm.config.ground import ZoneConfig
from swarm.errors import TerrainError

Damage = Callable[[dict[str, Any], random.Random], None]


def spot(at: Any, chance: random.Random) -> list[Any]:
    """A list of coordinates somewhere in a geometry."""
    while not isinstance(at[0][0], float):
        at = chance.choice(at)
    return at  # type: ignore[no-any-return]


def opened(f: dict[str, Any], chance: random.Random) -> None:
    ring = spot(f["geometry"]["coordinates"], chance)
    if ring[0] != ring[-1]:
        raise IndexError("a line has no ring to open")
    ring.pop()


def coordinate(value: Any) -> Damage:
    def damage(f: dict[str, Any], chance: random.Random) -> None:
        line = spot(f["geometry"]["coordinates"], chance)
        line[chance.randrange(len(line))] = value

    return damage


def geometry(make: Callable[[dict[str, Any]], Any]) -> Damage:
    def damage(f: dict[str, Any], chance: random.Random) -> None:
        f["geometry"] = make(f["geometry"])

    return damage


def collection(*more: Any) -> Damage:
    return geometry(lambda g: {"type": "GeometryCollection", "geometries": [*more, g]})


def reverse(f: dict[str, Any], chance: random.Random) -> None:
    f["geometry"] = shapely.geometry.mapping(
        shapely.transform(shapely.geometry.shape(f["geometry"]), lambda p: p[:, ::-1])
    )


DAMAGES: dict[str, Damage] = {
    "open ring": opened,
    "text": lambda f, chance: spot(f["geometry"]["coordinates"], chance).__setitem__(0, ["9.0", "46.9"]),
    "null number": coordinate([None, 46.94]),
    "null place": coordinate(None),
    "one number": coordinate([9.0]),
    "no number": coordinate([float("nan"), 46.94]),
    "infinite": coordinate([float("inf"), 46.94]),
    "truth": coordinate([True, 46.94]),
    "object": coordinate({"lon": 9.0, "lat": 46.9}),
    "far": coordinate([9.0, 4e6]),
    "null shape": geometry(lambda g: None),
    "no shape": lambda f, chance: f.pop("geometry"),
    "no coordinates": lambda f, chance: f["geometry"].pop("coordinates"),
    "empty": lambda f, chance: f["geometry"].update(coordinates=[]),
    "empty part": lambda f, chance: f["geometry"]["coordinates"].append([]),
    "too deep": lambda f, chance: f["geometry"].update(coordinates=[f["geometry"]["coordinates"]]),
    "too flat": lambda f, chance: f["geometry"].update(coordinates=f["geometry"]["coordinates"][0]),
    "small letters": lambda f, chance: f["geometry"].update(type=f["geometry"]["type"].lower()),
    "unknown type": lambda f, chance: f["geometry"].update(type="Circle"),
    "list in a list": lambda f, chance: f.update(type="FeatureCollection", features=[dict(f)]),
    "collection": collection(),
    "nested": collection({"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": [9, 46]}]}),
    "collection of null": collection(None),
    "collection of circles": collection({"type": "Circle", "coordinates": [9.0, 46.9]}),
    "reverse": reverse,
}


@st.composite
def shapes(draw: st.DrawFn) -> list[Any]:
    """Shapes on the terrain, beyond it, and in several parts."""
    made = []
    for _ in range(draw(st.integers(1, 4))):
        col, row = draw(st.integers(0, 44)), draw(st.integers(0, 34))
        area = shapely.box(col + 0.2, row + 0.3, col + 4.7, row + 4.6)
        hole = area.difference(shapely.box(col + 1.5, row + 1.5, col + 2.5, row + 2.5))
        line = shapely.LineString([(col, row + 0.4), (col + 3, row + 2.1), (col + 6, row + 0.2)])
        several = shapely.MultiPolygon([area, shapely.box(col + 5.5, row, col + 6.5, row + 1)])
        made.append(draw(st.sampled_from([area, hole, line, several, shapely.box(900, 900, 905, 905)])))
    return [shapely.box(1.1, 1.1, 2.9, 2.9), *made]


def closed_by(file: str, kind: str) -> np.ndarray:
    slow = {"factor": 2.0} if kind == "factor" else {}
    pace, _ = painted([ZoneConfig(kind=kind, file=file, width_m=3.0, **slow)])  # type: ignore[arg-type]
    return np.asarray(pace != np.float32(0.1))


@settings(max_examples=few(400), deadline=None)
@given(
    shapes(),
    st.sampled_from(sorted(DAMAGES)),
    st.sampled_from(["forbidden", "water", "factor", "keep_in"]),
    st.integers(),
)
def test_a_damaged_feature_closes_its_ground_or_ends_the_start(
    tmp_path_factory: pytest.TempPathFactory, drawn: list[Any], name: str, kind: str, seed: int
) -> None:
    chance, path = random.Random(seed), tmp_path_factory.mktemp("damage") / "a.geojson"
    if kind == "keep_in":
        drawn = [shape for shape in drawn if shape.geom_type != "LineString"]
    file = geojson(path, [feature(shape) for shape in drawn])
    text = json.loads(path.read_text())
    before = closed_by(file, kind)
    hurt = text["features"][chance.randrange(len(drawn))]
    try:
        DAMAGES[name](hurt, chance)
    except (IndexError, TypeError, KeyError):
        return  # it does not go with this shape
    path.write_text(json.dumps(text))
    refused = ""
    try:
        assert (closed_by(file, kind) == before).all()
    except TerrainError as error:
        refused = str(error)
    if refused:
        assert re.fullmatch(r".*a\.geojson.*", refused)
        with pytest.raises(TerrainError):
            outlines_of(ZoneConfig(kind="forbidden", file=file, width_m=3.0), UTM, 256)
