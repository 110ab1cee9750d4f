"""The pen that draws on a recording stream, and how it takes lines and texts.

Texts of others are shown so that they do nothing but stand there. Rerun's headless viewer ends on a character that
its fonts lack, and its text panel reads Markdown, where an image may be fetched. Ids are safe by their characters;
what an alarm or a note says, or what a zone is called, may be anything.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.sinks import Rec

Colour = tuple[int, int, int]
LABEL_COLOUR: Colour = (240, 243, 246)
_UNSHOWN = re.compile(r"[^ -~]+")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#!~&$])")
_LONGEST = 300


def shown(text: str, most: int = _LONGEST) -> str:
    """A text in one line of characters that every viewer has; `?` stands for others."""
    line = _UNSHOWN.sub("?", " ".join(text.split()))
    return line if len(line) <= most else line[: most - 3] + "..."


def in_markdown(text: str) -> str:
    """The same where Markdown is read: it says itself and does nothing."""
    return _MARKDOWN.sub(r"\\\1", shown(text))


@dataclass(frozen=True, slots=True, eq=False)
class Strips:
    """Lines of several points each, as rerun keeps them: of a list of lines it makes an array each, which took a
    third of a frame.

    points   float32 (m, 3), of all lines
    offsets  int32 (n + 1,): line n has points[offsets[n] : offsets[n + 1]]
    """

    points: Floats
    offsets: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Strips)
            and np.array_equal(self.offsets, other.offsets)
            and np.array_equal(self.points, other.points)
        )

    def line(self, n: int) -> Floats:
        """float32 (k, 3)."""
        points: Floats = self.points[self.offsets[n] : self.offsets[n + 1]]
        return points


def ragged(points: Floats, lengths: Sequence[int]) -> Strips:
    """Lines of these lengths, one after the other."""
    return Strips(points, np.cumsum([0, *lengths], dtype=np.int32))


def even(points: Floats) -> Strips:
    """float32 (n, m, 3): n lines of m points each."""
    count, each, _ = points.shape
    return ragged(points.reshape(-1, 3), [each] * count)


def screen(radius: float) -> float:
    """A radius in points of the viewer's window, the same at every zoom: rerun takes negative radii so."""
    return -radius


class Pen:
    """Draws on one recording stream, on one terrain. Style is logged once, of the rest only what differs from what
    was logged last: part by part, as rerun keeps what it is not told anew.

    rerun's viewer tells of the instance under the pointer what its components say, if they are three at most, else
    how many there are. So balls have three: a place, a colour, and a sentence. Their radii are in the blueprint.
    """

    def __init__(self, rec: Rec, mesh: TerrainMesh) -> None:
        self.rec, self.mesh = rec, mesh
        self._last: dict[tuple[str, str], Any] = {}

    def forget(self) -> None:
        """All is logged once more, when it is drawn."""
        self._last.clear()

    def news(self, entity: str, **parts: Any) -> dict[str, Any]:
        """Those parts of an entity which are not None and differ from what they were."""
        fresh = {
            name: part
            for name, part in parts.items()
            if part is not None and not _same(self._last.get((entity, name)), part)
        }
        self._last.update({(entity, name): part for name, part in fresh.items()})
        return fresh

    def placed(self, places_m: Sequence[tuple[float, float]], above: float) -> Floats:
        """Places, east and south in metres, as points so many `scale_m` over the ground, float32 (n, 3)."""
        east_south = np.array(places_m, np.float32).reshape(-1, 2)
        return self.mesh.place(east_south[:, 0], east_south[:, 1], above * self.mesh.scale_m)

    def style(self, entity: str, radius: float, colour: Colour | None = None) -> None:
        """How lines look, which never changes."""
        colours = None if colour is None else [colour]
        style = rr.LineStrips3D.from_fields(colors=colours, radii=[screen(radius)])
        self.rec.log(entity, style, static=True)

    def texts(
        self, entity: str, places: Floats, texts: list[str], colours: Sequence[Colour] | Bytes, *, static: bool
    ) -> None:
        """Labels without a ball."""
        labels = [shown(text, 60) for text in texts]
        points = rr.Points3D(places, labels=labels, colors=colours, radii=[screen(0.1)], show_labels=True)
        self.rec.log(entity, points, static=static)

    def label_style(self, entity: str, colour: Colour = LABEL_COLOUR) -> None:
        """An entity is labels that are always shown."""
        style = rr.Points3D.from_fields(colors=[colour], radii=[screen(0.1)], show_labels=True)
        self.rec.log(entity, style, static=True)

    def points(self, entity: str, sentences: Mapping[str, list[str] | None] | None = None, **parts: Any) -> None:
        """Points with these fields of rerun's; sentences by the name of their component."""
        fresh = self.news(entity, **parts)
        if "labels" in fresh:
            fresh["labels"] = pa.array(fresh["labels"], pa.string())
        told = self.news(entity, **(sentences or {}))
        told = {name: pa.array(each, pa.string()) for name, each in told.items()}
        if fresh or told:
            more = [rr.AnyValues(**told)] if told else []
            self.rec.log(entity, rr.Points3D.from_fields(**fresh), *more)

    def lines(self, entity: str, strips: Strips, colours: Bytes | None = None) -> None:
        """Lines; colours are those of each, uint8 (n, 3), or stay as they are."""
        if self.news(entity, strips=strips, colours=colours):
            self.trail(entity, strips, colours)

    def trail(self, entity: str, strips: Strips, colours: Bytes | None) -> None:
        """Lines beside those that were logged before. In rerun's own layout, without an array for each line."""
        wanted = rr.components.LineStrip3DBatch._ARROW_DATATYPE
        points = pa.array(np.ascontiguousarray(strips.points, np.float32).reshape(-1))
        triples = pa.FixedSizeListArray.from_arrays(points, type=wanted.value_type)
        lines = pa.ListArray.from_arrays(pa.array(strips.offsets), triples, type=wanted)
        self.rec.log(entity, rr.LineStrips3D.from_fields(strips=lines, colors=colours))


def _same(one: Any, other: Any) -> bool:
    return np.array_equal(one, other) if isinstance(other, np.ndarray) else bool(one == other)
