"""A moving picture of a run: vehicles, targets, captures and marks over its ground, as a GIF."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, UnidentifiedImageError

from launch_scripts.observe.files import write_file
from launch_scripts.observe.palette import BLACK, FAINT, GROUPS, INK, RED, YELLOW
from launch_scripts.observe.run_folder import read_report
from launch_scripts.report.geo.run_export import free_places, tracks_of_run
from launch_scripts.report.geo.track_file import RunTracks, Track
from launch_scripts.report.pictures.ground_picture import GROUND_FILE
from launch_scripts.report.pictures.map_picture import (
    Points,
    colours_of_groups,
    group_of,
    in_km,
    mark_overlay,
)
from launch_scripts.report.pictures.scale_bar import round_length, said_length
from swarm.clock import NS_PER_S
from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import ConfigError, StoreError

_LONG_SIDE_PX, _BAR_PX = 640, 34
_FRAMES, _FRAME_MS, _LAST_MS = 90, 90, 2000
_FINE = 2
"""Frames are drawn so many times as large, then made smaller: lines without steps."""
_TRAIL = 0.07
"""Trails are as long as this share of the run."""
_FLASH_FRAMES = 8
_LABELLED = 30
_UNCHANGED = 255
"""Palette index of pixels that are as in the frame before."""
_COLOURS = 128
"""Of the ground; more make a larger file."""


def export_gif(folder: Path, out: Path | None, force: bool) -> Path:
    """Write the moving picture of a run. Raises ConfigError or StoreError in one sentence."""
    report, tracks = read_report(folder), tracks_of_run(folder)
    if not any(len(track.time_ns) for track in (*tracks.vehicles, *tracks.targets)):
        raise ConfigError(f"{folder} has no tracks: nothing was heard of vehicles and targets")
    (path,) = free_places(folder, [f"{folder.resolve().name}.gif"], out, force)
    try:
        write_file(path, gif_of(ground_of(folder, tracks), tracks, report))
    except OSError as error:
        raise StoreError(f"cannot write {path}: {error.strerror or error}") from error
    return path


def ground_of(folder: Path, tracks: RunTracks) -> Image.Image:
    """The picture of the ground that the run left, as large as the moving one; plain where it left none."""
    grid, path = tracks.grid, folder / GROUND_FILE
    scale = _FINE * _LONG_SIDE_PX / max(grid.rows, grid.cols)
    size = max(round(grid.cols * scale), _FINE), max(round(grid.rows * scale), _FINE)
    if not path.exists():
        return Image.new("RGB", size, "#e3e6dd")
    try:
        with Image.open(io.BytesIO(read_bytes(path, FileKind.RUN))) as picture:
            return picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise StoreError(f"{path} is damaged: {error}") from error


def gif_of(ground: Image.Image, tracks: RunTracks, report: Mapping[str, Any]) -> bytes:
    """The GIF's content. All frames share one palette, so that only what moves takes bytes."""
    scene = _Scene(ground, tracks, report)
    palette = _palette(scene)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in scene.frames()]
    durations = [_FRAME_MS] * (len(frames) - 1) + [_LAST_MS]
    file = io.BytesIO()
    frames[0].save(
        file,
        "GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=True,
        disposal=1,
        transparency=_UNCHANGED,
    )
    return file.getvalue()


def _palette(scene: _Scene) -> Image.Image:
    """The ground's commonest colours and all that is drawn over it."""
    drawn = [
        *scene.colours.values(),
        *GROUPS,
        RED,
        YELLOW,
        BLACK,
        INK,
        FAINT,
        "#ffffff",
        "#f6f7f8",
        "#4a1486",
        "#E69F00",
    ]
    mixed = [_mixed(colour, "#ffffff", share) for colour in drawn for share in (0.0, 0.35, 0.7)]
    ground = scene.ground.resize((256, 256)).quantize(_COLOURS).getpalette() or []
    colours = [*(part for colour in dict.fromkeys(mixed) for part in colour), *ground[: 3 * _COLOURS]][
        : 3 * _UNCHANGED
    ]
    palette = Image.new("P", (1, 1))
    palette.putpalette([*colours, *[255, 0, 255] * (256 - len(colours) // 3)])
    return palette


def _mixed(colour: str, other: str, share: float) -> tuple[int, int, int]:
    one, two = (tuple(int(text[n : n + 2], 16) for n in (1, 3, 5)) for text in (colour, other))
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(one, two, strict=True))
    return red, green, blue


@dataclass(frozen=True, eq=False)
class _Moving:
    """at_px  (n, 2) places in the fine picture at time_ns"""

    id: str
    colour: str
    time_ns: NDArray[np.int64]
    at_px: Points

    def place(self, now_ns: float) -> tuple[float, float] | None:
        """Where it is; None before it was seen."""
        if now_ns < self.time_ns[0]:
            return None
        x, y = (float(np.interp(now_ns, self.time_ns, self.at_px[:, n])) for n in (0, 1))
        return x, y

    def trail(self, since_ns: float, now_ns: float) -> list[tuple[float, float]]:
        some = self.at_px[(self.time_ns >= since_ns) & (self.time_ns <= now_ns)]
        there = self.place(now_ns)
        return [(float(x), float(y)) for x, y in some] + ([there] if there is not None else [])


class _Scene:
    """What is drawn, in pixels of the fine picture.

    colours  group -> colour
    """

    def __init__(self, ground: Image.Image, tracks: RunTracks, report: Mapping[str, Any]) -> None:
        self.ground, self.tracks = ground, tracks
        self.colours = colours_of_groups(report)
        self._scale = ground.width / (tracks.grid.cols * tracks.grid.resolution_m / 1000)
        self._vehicles = [
            self._moving(track, self.colours.get(group_of(track.id, report), GROUPS[0]))
            for track in tracks.vehicles
            if len(track.time_ns)
        ]
        self._targets = [self._moving(track, RED) for track in tracks.targets if len(track.time_ns)]
        self._captures = [
            (int(track.time_ns[0]), tuple(in_km(track, tracks.grid)[0] * self._scale)) for track in tracks.captures
        ]
        known = [each.time_ns for each in (*self._vehicles, *self._targets)]
        self._began_ns = min(int(times[0]) for times in known)
        self._ended_ns = max(int(times[-1]) for times in known)
        self._font, self._small = (ImageFont.truetype(_font_file(bold), 13 * _FINE) for bold in (True, False))
        self._title = f"{report.get('scenario')}: {len(self._vehicles)} vehicles, {report.get('targets')} targets"
        self._dot = _FINE * (3.6 / max(1.0, len(self._vehicles) / 60) ** 0.35)

    def _moving(self, track: Track, colour: str) -> _Moving:
        return _Moving(track.id, colour, track.time_ns, in_km(track, self.tracks.grid) * self._scale)

    def frames(self) -> Iterator[Image.Image]:
        many = max(2, min(_FRAMES, 1 + (self._ended_ns - self._began_ns) // (NS_PER_S // 4)))
        size = self.ground.width // _FINE, self.ground.height // _FINE + _BAR_PX
        for now_ns in np.linspace(self._began_ns, self._ended_ns, many).tolist():
            yield self._frame(now_ns, (self._ended_ns - self._began_ns) / many).resize(size, Image.Resampling.BOX)

    def _frame(self, now_ns: float, frame_ns: float) -> Image.Image:
        picture = Image.new("RGB", (self.ground.width, self.ground.height + _FINE * _BAR_PX), "#f6f7f8")
        ground = self.ground.copy()
        self._draw_marks(ground, now_ns)
        picture.paste(ground)
        draw = ImageDraw.Draw(picture)
        since_ns = now_ns - _TRAIL * (self._ended_ns - self._began_ns)
        for vehicle in self._vehicles:
            trail = vehicle.trail(since_ns, now_ns)
            if len(trail) > 1:
                draw.line(trail, vehicle.colour, round(0.7 * self._dot), "curve")
        for vehicle in self._vehicles:
            if (there := vehicle.place(now_ns)) is not None:
                draw.circle(there, self._dot, vehicle.colour, "#ffffff", _FINE // 2)
        for at_ns, place in self._captures:
            if at_ns <= now_ns:
                fresh = max(0.0, 1 - (now_ns - at_ns) / (_FLASH_FRAMES * max(frame_ns, 1)))
                draw.polygon(_star(place, _FINE * (5 + 11 * fresh)), YELLOW, BLACK, _FINE // 2)
        self._draw_targets(draw, now_ns)
        self._draw_bar(draw, now_ns)
        return picture

    def _draw_marks(self, ground: Image.Image, now_ns: float) -> None:
        marks = self.tracks.marks
        known = marks.stamps_ns <= now_ns
        if known.any():
            shown = mark_overlay(self.tracks, known)
            overlay = Image.fromarray(shown).resize(ground.size, Image.Resampling.NEAREST)
            ground.paste(overlay, mask=overlay.getchannel("A"))

    def _draw_targets(self, draw: ImageDraw.ImageDraw, now_ns: float) -> None:
        newest: dict[str, _Moving] = {}
        for piece in self._targets:
            if piece.time_ns[0] <= now_ns and (
                piece.id not in newest or piece.time_ns[0] >= newest[piece.id].time_ns[0]
            ):
                newest[piece.id] = piece
        for id, piece in newest.items():
            x, y = piece.place(now_ns) or (0.0, 0.0)
            side = 6.5 * _FINE
            draw.polygon([(x, y - side), (x + side, y), (x, y + side), (x - side, y)], RED, "#ffffff", _FINE)
            if len(newest) <= _LABELLED:
                draw.text(
                    (x + 8 * _FINE, y - 8 * _FINE),
                    id,
                    RED,
                    self._font,
                    "lb",
                    stroke_width=_FINE,
                    stroke_fill="#ffffff",
                )

    def _draw_bar(self, draw: ImageDraw.ImageDraw, now_ns: float) -> None:
        width, middle = self.ground.width, self.ground.height + _FINE * _BAR_PX // 2
        caught = sum(at_ns <= now_ns for at_ns, _ in self._captures)
        draw.text((10 * _FINE, middle), self._title, INK, self._font, "lm")
        text = f"{caught} captures   {(now_ns - self._began_ns) / NS_PER_S:.0f} s"
        draw.text((width - 10 * _FINE, middle), text, INK, self._font, "rm")
        bar_km = round_length(width / self._scale / 5)
        x, y = 12 * _FINE, self.ground.height - 12 * _FINE
        draw.line([(x, y), (x + bar_km * self._scale, y)], "#ffffff", 5 * _FINE)
        draw.line([(x, y), (x + bar_km * self._scale, y)], INK, 2 * _FINE)
        draw.text(
            (x, y - 5 * _FINE),
            said_length(bar_km * 1000),
            INK,
            self._small,
            "lb",
            stroke_width=_FINE,
            stroke_fill="#ffffff",
        )


def _star(place: Sequence[float], radius: float) -> list[tuple[float, float]]:
    turns = np.arange(10) * np.pi / 5 - np.pi / 2
    radii = np.where(np.arange(10) % 2, 0.42 * radius, radius)
    return [
        (place[0] + float(r * np.cos(a)), place[1] + float(r * np.sin(a)))
        for r, a in zip(radii, turns, strict=True)
    ]


def _font_file(bold: bool) -> str:
    return str(Path(mpl.get_data_path(), "fonts", "ttf", "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"))
