"""Layout of the view: the layers between which a person switches, their legends, and the metrics beside them.

A layer is a tab with the same swarm on other ground. A legend is a picture, as a text panel of the viewer can show
neither colours nor pictures.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from PIL import Image, ImageDraw, ImageFont
from rerun.blueprint.encodings import TextLogColumn

from launch_scripts.monitor import ground_colours as colours
from launch_scripts.monitor.rerun_outputs import Colour, Pen, in_markdown, inline, screen
from launch_scripts.monitor.styles import FOLLOWED_ENTITY, HINT, HUES, Entry, Level, level_for
from launch_scripts.monitor.terrain_mesh import TerrainMesh
from launch_scripts.observe import palette
from launch_scripts.observe import run_state as facts
from launch_scripts.observe.alarms import KINDS
from launch_scripts.observe.run_state import RunState
from swarm.config.scenario import Scenario
from swarm.runtime.role_setup import RoleSetup
from swarm.wire.messages.vehicles import VehicleState

BACKGROUND = (17, 22, 28)
_BARE = (44, 50, 52)
"""Colour of ground whose picture has not come yet; rerun's own is white."""
WIDTH_PX, HEIGHT_PX = 1840, 156
_TEXT = (223, 227, 232)
_ROWS = ((4, 25), (5, 21))
"""Rows, and how large their text is: more and smaller ones where columns would not fit."""
_SIZE_PX, _SWATCH_PX, _TEXT_PX, _GAP_PX = 20, (40, 18), 52, 30
_LEFT_PX, _SCALE_PX = 14, 420
_FINE = 4
"""Factor by which shapes are drawn larger before they are scaled down, so that their edges are smooth."""
ZONE_COLOURS: dict[str, Colour] = {
    "no-go": colours.NO_GO,
    "slow": colours.SLOW_MARK,
    "quick": colours.FAST_MARK,
    "pace": palette.rgb(palette.PINK),
}
_WARNINGS = ("restart", "crash", "lost", "stranded", "mismatch", "gone", "refused", "outside")
_SHOWN_TARGETS = 12
"""Lines of the table beside the view, chosen by eye: more would have to be scrolled to. A line below tells how many
more there are."""
_SHOWN_ALARMS = 8
"""Lines at the head of the same panel, chosen by eye: more of them would push the table out of it."""


_CLOSED = (Entry("hatch", colours.HATCH, "known to be lethal"), Entry("hatch", colours.NO_GO, "no-go zone"))


class Layer(NamedTuple):
    """A tab of the view.

    name     of its legend
    entity   which has the ground of this layer
    entries  of its legend, about the ground
    target   whose routes alone it shows; None for all
    """

    name: str
    title: str
    entity: str
    entries: tuple[Entry, ...]
    target: str | None = None


PHOTO = Layer(
    "photo", "Photo", "world/ground",
    (*_CLOSED, Entry("fill", colours.LETHAL_MARK, "found lethal"), Entry("fill", colours.SLOW_MARK, "found slow"),
     Entry("fill", colours.FAST_MARK, "found quick")),
)  # fmt: skip
COST = Layer("cost", "Cost", "world/layers/cost", (*_CLOSED, Entry("fill", colours.LETHAL_PRIOR, "found lethal")))
KNOWN = Layer(
    "known", "Known and true", "world/layers/known",
    (Entry("fill", colours.FOUND, "hidden, and found"),
     Entry("fill", colours.STILL_HIDDEN_LETHAL, "lethal, not yet found"),
     Entry("fill", colours.STILL_HIDDEN_SLOW, "slower or quicker, not yet found"),
     Entry("fill", colours.OVERRULED, "marked or ordered, yet not so")),
)  # fmt: skip
LEARNED = Layer("learned", "Learned", "world/layers/learned", _CLOSED)
TO_TARGET = Layer(
    "to_target", "To", "world/layers/to_target",
    (Entry("line", colours.TREE, "where the cost falls most"), Entry("fill", colours.UNREACHED, "no way from here"),
     Entry("fill", colours.LETHAL_PRIOR, "lethal")),
)  # fmt: skip
NEAREST = Layer("nearest", "Nearest target", "world/layers/nearest", ())


def layers_of(scenario: Scenario, *, knows_truth: bool) -> list[Layer]:
    """The layers of a run, in order of their tabs."""
    targets = scenario.target_ids
    layers = [PHOTO, COST]
    if knows_truth:
        layers.append(KNOWN)
    if scenario.map.learning:
        layers.append(LEARNED)
    if targets:
        target = scenario.monitor.show_target or targets[0]
        layers.append(TO_TARGET._replace(title=f"To {target}", target=target))
    if len(targets) > 1:
        nearest = (Entry("fill", hue, f"nearest: {id}") for id, hue in zip(targets, HUES, strict=False))
        layers.append(NEAREST._replace(entries=tuple(nearest)))
    return layers


class Scale(NamedTuple):
    """A bar of colours, evenly between those named, and texts evenly along it."""

    colours: Sequence[str]
    title: str
    texts: Sequence[str]


def legend_picture(entries: Sequence[Entry], scale: Scale | None = None) -> bytes:
    """A PNG of `WIDTH_PX` x `HEIGHT_PX`."""
    image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), BACKGROUND)
    draw = ImageDraw.Draw(image)
    left = float(_LEFT_PX)
    if scale is not None:
        _draw_scale(image, draw, scale)
        left += _SCALE_PX + 2 * _GAP_PX
    for rows, size in _ROWS:
        font = ImageFont.load_default(size)
        columns = [entries[first : first + rows] for first in range(0, len(entries), rows)]
        widths = [_TEXT_PX + max(font.getlength(entry.meaning) for entry in column) + _GAP_PX for column in columns]
        if left + sum(widths) <= WIDTH_PX:
            break
    for column, width in zip(columns, widths, strict=True):
        for row, entry in enumerate(column):
            middle = round((row + 0.5) * HEIGHT_PX / rows)
            image.paste(_swatch(entry), (round(left), middle - _SWATCH_PX[1] // 2))
            draw.text((left + _TEXT_PX, middle), entry.meaning, _TEXT, font, anchor="lm")
        left += width
    file = io.BytesIO()
    image.save(file, "PNG", compress_level=1)  # of a scale that changes all the time most of the work is to pack it
    return file.getvalue()


def _swatch(entry: Entry) -> Image.Image:
    width, height = (_FINE * side for side in _SWATCH_PX)
    image = Image.new("RGB", (width, height), BACKGROUND)
    draw = ImageDraw.Draw(image)
    middle, colour, thick = width // 2, entry.colour, 2 * _FINE
    square, whole = (middle - height // 2, 0, middle + height // 2 - 1, height - 1), (0, 0, width - 1, height - 1)
    match entry.shape:
        case "fill":
            draw.rectangle(whole, colour, _TEXT, _FINE // 2)
        case "hatch":
            for start in range(-height, width, height // 2):
                draw.line((start, height, start + height, 0), colour, thick)
            draw.rectangle(whole, None, colour, _FINE)
        case "line":
            draw.line((0, height // 2, width, height // 2), colour, 2 * thick)
        case "ball":
            draw.ellipse(square, colour, _TEXT, _FINE // 2)
        case "ring":
            draw.ellipse(square, None, colour, thick)
    return image.resize(_SWATCH_PX, Image.Resampling.LANCZOS)


def _draw_scale(image: Image.Image, draw: ImageDraw.ImageDraw, scale: Scale) -> None:
    font, top = ImageFont.load_default(_SIZE_PX), HEIGHT_PX // 2 - 42
    draw.text((_LEFT_PX, top), scale.title, _TEXT, font, anchor="lm")
    bar = colours.between(scale.colours, _SCALE_PX).astype(np.uint8)
    image.paste(Image.fromarray(np.repeat(bar[None], 28, axis=0)), (_LEFT_PX, top + 20))
    last = len(scale.texts) - 1
    for n, text in enumerate(scale.texts):
        anchor = {0: "lm", last: "rm"}.get(n, "mm")
        draw.text((_LEFT_PX + n / last * _SCALE_PX, top + 66), text, _TEXT, font, anchor=anchor)


def make_blueprint(
    mesh: TerrainMesh, layers: Sequence[Layer] = (PHOTO,), *, vehicles: int = 100, follow: str | None = None
) -> rrb.Blueprint:
    """Layers of the 3D view on the left, each with its legend; figures, plots and the log on the right.

    vehicles  how many there are, which decides how much is drawn of each
    follow    vehicle or target that the camera follows
    """
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*(_layer(mesh, layer, vehicles, follow) for layer in layers), active_tab=0),
            rrb.Vertical(
                rrb.TextDocumentView(origin="/summary", name="Now"),
                _plot("captures_and_marks", "Captures and marks"),
                _plot("gap", "Certified gap of the routes to each target, mean, %", legend=False),
                rrb.Tabs(
                    _plot("messages", "Messages per second", legend=False),
                    _plot("growth_ms", "Growth of the trees, ms", legend=False),
                    _plot("states", "Vehicles by state"),
                ),
                _log(),
                row_shares=[3.5, 1.1, 1.1, 1.2, 1.35],
            ),
            column_shares=[2.6, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="sim_time", play_state="following"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


def _layer(mesh: TerrainMesh, layer: Layer, vehicles: int, follow: str | None) -> rrb.Vertical:
    """A tab: the swarm on the ground of one layer, and the legend beneath it."""
    legend = rrb.Spatial2DView(
        origin=f"/legend/{layer.name}",
        name="Legend",
        background=rrb.Background(color=BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=(0, WIDTH_PX), y_range=(0, HEIGHT_PX)),
    )
    return rrb.Vertical(_view_3d(mesh, layer, vehicles, follow), legend, row_shares=[5.4, 1], name=layer.title)


def _view_3d(mesh: TerrainMesh, layer: Layer, vehicles: int, follow: str | None) -> rrb.Spatial3DView:
    contents = ["+ /world/**", "- /world/layers/**"]
    if layer != PHOTO:
        contents += [f"- /{PHOTO.entity}/**", f"+ /{layer.entity}/**"]
    if layer.target is not None:
        contents += ["- /world/routes/**", f"+ /world/routes/{layer.target}"]
    far = max(mesh.width_m, mesh.depth_m)
    if follow:  # the followed one is the origin of the view: the world moves below it
        eye, centre = (-0.02 * far, -0.16 * far, 0.11 * far), (0.0, 0.0, 0.0)
    else:
        east, north, up = mesh.width_m / 2, -mesh.depth_m / 2, float(mesh.heights_m.mean())
        eye, centre = (east - 0.05 * far, north - 0.84 * far, up + 0.62 * far), (east, north - 0.19 * far, up)
    return rrb.Spatial3DView(
        origin=f"/{FOLLOWED_ENTITY}" if follow else "/world",
        contents=contents,
        name=", ".join((layer.title, mesh.heights_text, f"following {follow}" if follow else HINT)),
        background=rrb.Background(color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=centre, eye_up=(0, 0, 1)
        ),
        overrides=_sizes(level_for(vehicles)),
        defaults=[rr.Mesh3D.from_fields(albedo_factor=_BARE)],
    )


def _sizes(level: Level) -> dict[Any, Any]:
    """Radii of what moves, and how long trails are seen."""
    trail = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-level.trail_s),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    px = {"vehicles": level.radius_px, "targets/balls": 8.5, "goals/flags": 6.0}
    radii = {f"/world/{entity}": rr.Points3D.from_fields(radii=[screen(radius)]) for entity, radius in px.items()}
    trails = {f"/world/trails/{whose}": rrb.VisibleTimeRanges([trail]) for whose in ("vehicles", "targets")}
    return {**radii, **trails}


def _plot(name: str, title: str, legend: bool = True) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"/plots/{name}",
        name=title,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
    )


def _log() -> rrb.TextLogView:
    columns = [TextLogColumn(name, visible=name != "EntityPath") for name in ("EntityPath", "LogLevel", "Body")]
    return rrb.TextLogView(
        origin="/log",
        name="Log",
        columns=rrb.TextLogColumns(text_log_columns=columns, timeline_columns=["sim_time"]),
    )


class FiguresPanel:
    """Logs plots, the summary and notes."""

    def __init__(self, pen: Pen, target_ids: Sequence[str]) -> None:
        self._pen = pen
        self._target_ids = list(target_ids)

    def begin(self) -> None:
        """Logs what never changes: the styles."""
        targets = [HUES[n % len(HUES)] for n in range(len(self._target_ids))]
        states = [state.name.lower() for state in VehicleState]
        for chart, names, hues in (
            ("states", states, HUES[: len(states)]),
            ("captures_and_marks", ["captures", "marks / 100"], [(255, 210, 31), (170, 110, 240)]),
            ("gap", self._target_ids, targets),
            ("growth_ms", self._target_ids, targets),
            ("messages", ["all processes"], [(86, 180, 233)]),
        ):
            self._pen.log(f"plots/{chart}", rr.SeriesLines(names=names, colors=hues, widths=1.5), static=True)

    def plots(self, state: RunState) -> None:
        """Logs a point of each line whose value is known."""
        of = {line.id: line for line in state.targets}
        lines = [of.get(id) for id in self._target_ids]
        gaps = [None if line is None or line.gap is None else line.gap.mean for line in lines]
        charts: dict[str, Sequence[float | None]] = {
            "states": [*state.states.values()],
            "captures_and_marks": [state.captures, None if state.marks is None else state.marks / 100],
            "gap": [None if gap is None else (gap - 1) * 100 for gap in gaps],
            "growth_ms": [None if line is None else line.growth_ms for line in lines],
            "messages": [state.messages_now_per_s],
        }
        for chart, values in charts.items():
            numbers = np.array(values, np.float64)  # None becomes NaN
            if np.isfinite(numbers).any():
                self._pen.log(f"plots/{chart}", rr.Scalars(numbers))

    def summary(self, markdown: str) -> None:
        """Logs the text beside the view."""
        self._pen.log("summary", rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN))

    def note(self, text: str, level: str) -> None:
        """Logs a line, at a level as rerun names it."""
        self._pen.log("log", rr.TextLog(inline(text), level=level))


def level_of(kind: str) -> str:
    """Logs level of a note, as rerun names it."""
    return "WARN" if kind in KINDS or any(word in kind for word in _WARNINGS) else "INFO"


def summary_markdown(setup: RoleSetup, state: RunState) -> str:
    """The state of a run, as Markdown."""
    time = facts.fact("elapsed_s")
    lines = [f"**{in_markdown(setup.scenario.name)}**, {time.label} {time.format(state)}  "]
    lines += [f"{line}  " for line in facts.lines(state)]
    lines += [f"**{in_markdown(line)}**  " for line in facts.alarm_lines(state, _SHOWN_ALARMS)]
    labels, rows = facts.table(state)
    lines += ["", f"| {' | '.join(labels)} |", f"|{'---|' * len(labels)}"]
    lines += [f"| {' | '.join(map(in_markdown, row))} |" for row in rows[:_SHOWN_TARGETS]]
    if len(rows) > _SHOWN_TARGETS:
        lines.append(f"\n{len(rows) - _SHOWN_TARGETS} more targets")
    return "\n".join(lines)
