"""The pictures of docs/method/paper.md, computed by the planner's own trees on small grids. They are deterministic.

python -m docs.generate.method_pictures [NAME ...]

`printed` has the rules of the paper from which this project differs.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from docs.generate.printed import Pace, Place, lattice_route, printed_costs, printed_range
from launch_scripts.observe.palette import BLACK, BLUE, GREEN, INK, ORANGE, RED
from planner_service.strategy import ROWS, STAGES, Strategy
from planner_service.target_tree import TargetTree
from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.strides import all_cells, find_stride
from swarm.config.scenario import PlannerConfig
from swarm.grid import STEP_COL, STEP_ROW, GridSpec

IMAGES = Path(__file__).parents[1] / "images"
Trail = NDArray[np.int64]
_MOVES = np.stack((STEP_ROW, STEP_COL), axis=1)
_GROUND = LinearSegmentedColormap.from_list("ground", ["#f6f3ea", "#d9cfae", "#a68a5b"])
_WALL = ListedColormap(["#4a4f57"])
_GAP = LinearSegmentedColormap.from_list("gap", ["#f2f7f4", "#fbd9a0", ORANGE, RED, "#6d1404"])
LABEL: Any = {"fc": "white", "ec": "none", "pad": 1.0, "alpha": 0.8}
"""The box behind a text on the map."""


class Chase:
    """A target's tree on a small map, and where the target is."""

    def __init__(self, pace: Pace, target: Place, row: Strategy | None = None, **config: Any) -> None:
        self.pace = pace
        self.grid = GridSpec(pace.shape[0], pace.shape[1], 1.0)
        self.tree = TargetTree(self.grid, PlannerConfig(**config), chosen_by=row)
        self.widths: list[int] = []
        self.go(target)

    def go(self, target: Place) -> Any:
        """Moves the target; the tree follows. A full growth which falls due is done at once."""
        self.target = target
        cell = self.grid.cell(*target)
        done = self.tree.update(self.pace, cell, [], 0)
        if done.wants_full:
            done = self.tree.adopt(self.tree.full_job(cell)(), self.pace, cell, [], 0, [])
        if self.tree.wants_strides:
            self.tree.take_strides(self.tree.stride_job()())
        self.widths.append(done.window.row1 - done.window.row0)
        return done

    def trail(self, start: Place) -> Trail:
        """(n, 2) places of the route from a cell to the target."""
        route = self.tree.routes([self.grid.cell(*start)])[0]
        moves = _MOVES[np.frombuffer(route.directions, np.uint8)]
        return np.concatenate([[start], np.array(start) + np.cumsum(moves, axis=0)])

    def costs(self) -> NDArray[np.float64]:
        """Returns (rows, cols), s: the time to drive the route of each cell; inf without a route."""
        return self.tree.routes(np.arange(self.grid.cells)).cost_s.reshape(self.pace.shape)


def tree() -> Figure:
    """A cost map, the parents of all cells, and the route of a vehicle."""
    pace = _hills(14, 22, seed=5, strength=2.4)
    pace[3:10, 9] = np.inf
    start, target = (11, 3), (4, 17)
    chase = Chase(pace, target, strategy="full")
    figure, (axes,) = maps(1, (6.6, 4.3))
    draw_ground(axes, pace)
    trails = [chase.trail((int(row), int(col))) for row, col in np.argwhere(np.isfinite(pace))]
    first = np.array([trail[:2] for trail in trails if len(trail) > 1])
    (south, east), (row, col) = (first[:, 1] - first[:, 0]).T * 0.64, first[:, 0].T
    axes.quiver(
        col, row, east, south, angles="xy", scale_units="xy", scale=1, pivot="mid", color="#7d7357", width=0.0022,
        headwidth=5, headlength=6,
    )  # fmt: skip
    _draw_chase(axes, chase.trail(start), start, target)
    axes.set_title("Each cell's parent; brown cells cost more, the wall is lethal")
    return figure


def reversed_edges() -> Figure:
    """The cheaper of two targets, if the tree is grown along the edges, and against them."""
    pace = np.ones((36, 60), np.float32)
    row, col = np.indices(pace.shape)
    pace[np.hypot(row - 18, col - 14) < 3.5] = 12.0
    places, vehicle = ((18, 14), (18, 56)), (27, 18)
    chases = [Chase(pace, place, strategy="full") for place in places]
    driven = np.stack([chase.costs() for chase in chases])
    as_printed = np.stack([printed_costs(pace, place) for place in places])
    figure, panels = maps(2, (9.2, 3.3))
    sides = ((as_printed, "Along the edges, as printed"), (driven, "Against the edges"))
    for axes, (costs, title) in zip(panels, sides, strict=True):
        choice = costs.argmin(axis=0)
        axes.imshow(choice, cmap=ListedColormap(["#d6e9f5", "#fdebd0"]), vmin=0, vmax=1)
        axes.contourf(pace > 1, levels=[0.5, 2], colors=[INK], alpha=0.18)
        dearer = choice != driven.argmin(axis=0)
        if dearer.any():
            axes.contourf(dearer, levels=[0.5, 1.5], colors="none", hatches=["////"])
            axes.text(24, 34, "hatched: sent to the costlier target", fontsize=8.5, color=INK)
        taken = int(choice[vehicle])
        _draw_chase(axes, chases[taken].trail(vehicle), vehicle, places[taken])
        for place, colour, name in zip(places, (BLUE, ORANGE), ("A, in a swamp", "B"), strict=True):
            draw_target(axes, place, colour)
            axes.text(place[1], place[0] - 2.6, name, ha="center", fontsize=9, color=INK, bbox=LABEL)
        figures = f"to {'AB'[taken]}: {costs[taken][vehicle]:.0f} s promised, {driven[taken][vehicle]:.0f} s driven"
        axes.set_title(f"{title}\n{figures}")
    return figure


def range_rule() -> Figure:
    """The width of the window of each move of a target, by the printed condition and by blocks that are left."""
    figure = Figure(figsize=(9.2, 3.5), layout="constrained")
    left, *right = figure.subplots(1, 3, width_ratios=[1.05, 1.2, 1.2])
    _draw_windows(left)
    moves = range(1, 33)
    for axes, step, title in zip(right, ((0, 1), (1, 1)), ("Along a row", "Along a diagonal"), strict=True):
        chase = Chase(np.ones((257, 257), np.float32), (128, 128), strategy="variable_range", k_min=2)
        for n in moves:
            chase.go((128 + n * step[0], 128 + n * step[1]))
        printed = [printed_range(n * step[0], n * step[1], k_min=2) for n in moves]
        axes.bar(moves, chase.widths[1:], width=0.62, color="#bfe3d6", edgecolor=GREEN, linewidth=0.8, label="ours")
        axes.plot(moves, printed, "o", ms=3.6, color=RED, label="the printed condition")
        axes.set(yscale="log", ylim=(6, 200), xlabel="moves since the start", title=title)
        axes.set_yticks([9, 17, 33, 65, 129], ["9", "17", "33", "65", "129"])
        axes.minorticks_off()
    right[0].set_ylabel("cells that the window is wide")
    right[0].legend(loc="upper left", borderaxespad=0.2)
    return figure


def _draw_windows(axes: Axes) -> None:
    """Draws the three smallest windows around a target, over the blocks whose borders decide between them."""
    axes.set(xlim=(-17.5, 17.5), ylim=(-17.5, 17.5), aspect="equal", title="Windows for k_min = 2")
    axes.set(xticks=[], yticks=[])
    for line in range(-16, 17, 4):
        for draw in (axes.axhline, axes.axvline):
            draw(line - 2.5, color="#c9ced4", lw=1.1 if line % 8 == 0 else 0.5, zorder=0)
    sides = ((9, GREEN, "every move"), (17, BLUE, "out of a 4 x 4 block"), (33, ORANGE, "out of an 8 x 8 block"))
    for width, colour, text in sides:
        side = Rectangle((-width / 2, -width / 2), width, width, fill=False, ec=colour, lw=1.8)
        axes.add_patch(side)
        axes.text(
            0, width / 2 - 0.3, f"{width}: {text}", color=colour, fontsize=8.5, ha="center", va="top",
            weight="bold", bbox=LABEL | {"alpha": 1.0},
        )  # fmt: skip
    draw_target(axes, (0, 0))


def tracking() -> Figure:
    """A vehicle whose route ends where the target was; and one whose route is renewed while it drives."""
    pace = _hills(92, 132, seed=11, strength=0.7)
    pace[46:49, :] = np.inf
    for bridge in (62, 98):
        pace[46:49, bridge : bridge + 4] = 1.0
    start, target = (85, 50), (12, 65)
    figure, panels = maps(2, (9.2, 3.5))
    sides = (
        ("variable_range", "Windows, and a new route where the old one ends"),
        ("exact", "Exact moves, newer routes pushed"),
    )
    for axes, (strategy, title) in zip(panels, sides, strict=True):
        chase = Chase(pace, target, strategy=strategy, k_min=2)
        was = chase.trail(start)
        driven, ends = _drive(chase, start, [(12, 65 + n) for n in range(1, 31)])
        draw_ground(axes, pace)
        axes.plot([target[1], chase.target[1]], [target[0]] * 2, color=RED, lw=1.4, ls=":")
        axes.plot(target[1], target[0], "*", ms=10, mfc="white", mec=RED)
        _draw_chase(axes, driven, start, chase.target)
        axes.plot(was[:, 1], was[:, 0], color=INK, lw=1.6, ls="--")
        for row, col in ends:
            axes.annotate(
                "the route ends here:\nthe target has gone", (col, row), (col - 42, row + 9), fontsize=8.5,
                color=INK, arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 0.8},
            )  # fmt: skip
        axes.set_title(f"{title}\ntarget reached after {len(driven) - 1} frames")
    return figure


def _drive(chase: Chase, start: Place, way: Sequence[Place]) -> tuple[Trail, list[Place]]:
    """Returns the way of a vehicle, and where its routes ended before it met the target.

    It drives a cell a frame, its target one in two. It gets a newer route when it stands in the grown window,
    and asks for one when its own has ended.
    """
    driven, ends = [start], []
    ahead = iter(chase.trail(start)[1:])
    while (
        max(abs(driven[-1][0] - chase.target[0]), abs(driven[-1][1] - chase.target[1])) > 1 and len(driven) <= 400
    ):
        moves, odd = divmod(len(driven), 2)
        if not odd and moves <= len(way) and chase.go(way[moves - 1]).window.contains(*driven[-1]):
            ahead = iter(chase.trail(driven[-1])[1:])
        if (place := next(ahead, None)) is None:
            ends.append(driven[-1])
            ahead = iter(chase.trail(driven[-1])[1:])
            place = next(ahead)
        driven.append((int(place[0]), int(place[1])))
    return np.array(driven), ends


def schedule() -> Figure:
    """The gap of the route of every cell after a target has moved 120 cells."""
    pace = _hills(160, 160, seed=3, strength=1.6)
    walls = gaussian_filter(np.random.default_rng(4).standard_normal(pace.shape), 5)
    pace[walls > 1.7 * walls.std()] = np.inf
    begin = (110, 22)
    way = Chase(pace, (38, 140), strategy="full").trail(begin)[1:121]
    exact = Chase(pace, (int(way[-1][0]), int(way[-1][1])), strategy="full").costs()
    figure, panels = maps(2, (8.4, 3.9))
    sides = (
        (ROWS["variable_range"], "The paper's windows"),
        (STAGES["rotate"], "Doubling windows, renewed every 13 moves"),
    )
    for axes, (row, name) in zip(panels, sides, strict=True):
        chase = Chase(pace, begin, row, k_min=2, cpu_budget=1.2e-4)
        for place in way:
            chase.go((int(place[0]), int(place[1])))
        with np.errstate(invalid="ignore"):
            gap = np.nan_to_num((chase.costs() / exact - 1) * 100, posinf=np.inf)
        seen = gap[np.isfinite(pace)]
        shown = axes.imshow(gap, cmap=_GAP.resampled(10), vmin=0, vmax=25)
        axes.imshow(np.where(np.isfinite(pace), np.nan, 1.0), cmap=_WALL)
        axes.plot(way[:, 1], way[:, 0], color=INK, lw=1.0, ls=":")
        draw_target(axes, chase.target)
        axes.set_title(f"{name}\nmean {seen.mean():.2f} %, 95th percentile {np.percentile(seen, 95):.1f} %")
    figure.colorbar(shown, ax=panels, shrink=0.85, label="driven above the optimum, %", extend="max")
    return figure


def strides() -> Figure:
    """A thin wall, under a lattice of every eighth cell and under blocks of as many."""
    pace = _hills(64, 96, seed=8, strength=0.9)
    pace[14:64, 30] = pace[0:46, 62] = np.inf
    start, target = (52, 4), (20, 84)
    figure, (left, right) = maps(2, (9.2, 3.6))
    for axes in (left, right):
        draw_ground(axes, pace)
    jumped = lattice_route(pace, start, target, stride=8)
    rows, cols = np.mgrid[4:64:8, 4:96:8]
    left.plot(cols.ravel(), rows.ravel(), ".", ms=2.4, color="#8b8371")
    _draw_chase(left, jumped, start, target, RED)
    for a, b in pairwise(jumped):
        if np.isinf(pace[tuple(np.linspace(a, b, 9).round().astype(int).T)]).any():
            left.plot((a[1] + b[1]) / 2, (a[0] + b[0]) / 2, "x", ms=11, mew=2.6, color=BLACK)
    left.set_title("Every eighth cell: the route passes through two walls")
    for line in range(0, 97, 8):
        for draw in (right.axhline, right.axvline):
            draw(line - 0.5, color="#c9ced4", lw=0.5, zorder=1)
    centres, ways = _network(pace, stride=8)
    for way in ways:
        right.plot(way[:, 1], way[:, 0], color=BLUE, lw=0.8, alpha=0.7)
    right.plot(centres[:, 1], centres[:, 0], "o", ms=2.6, color=BLUE)
    _draw_chase(right, Chase(pace, target, strategy="full").trail(start), start, target)
    right.set(xlim=(-0.5, 95.5), ylim=(63.5, -0.5), title="Nodes and links of a stride of 8, and the route")
    return figure


def _network(pace: Pace, stride: int) -> tuple[Trail, list[Trail]]:
    """(n, 2) places of the centres of a stride's nodes, and those of the way of each link."""
    costs = CostGrid(GridSpec(pace.shape[0], pace.shape[1], 1.0), PlannerConfig())
    costs.load(pace)
    centre, links = find_stride(costs, stride, all_cells(costs), np.empty(0, np.int64), 0)
    centres = np.stack(np.divmod(centre.astype(np.int64), costs.stride), axis=1) - 1
    paths = np.split(links.paths, np.cumsum(links.length)[:-1])
    ways = [
        np.concatenate([[start], start + np.cumsum(_MOVES[path], axis=0)])
        for start, path in zip(centres[links.ends[0]], paths, strict=True)
    ]
    return centres, ways


# --- how it looks -----------------------------------------------------------------------------------------------


def _hills(rows: int, cols: int, seed: int, strength: float) -> Pace:
    """Paces of gentle hills, s/m, from 1 on."""
    rough = gaussian_filter(np.random.default_rng(seed).standard_normal((rows, cols)), min(rows, cols) / 12)
    pace: Pace = (1 + strength * np.abs(rough / rough.std()) ** 1.3).astype(np.float32)
    return pace


def maps(panels: int, size: tuple[float, float]) -> tuple[Figure, list[Axes]]:
    """A figure of maps side by side."""
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, panels, subplot_kw={"xticks": [], "yticks": []})
    return figure, list(np.atleast_1d(axes))


def draw_ground(axes: Axes, pace: Pace) -> None:
    """Draws paces from white to brown, and lethal cells dark."""
    finite = np.where(np.isfinite(pace), pace, np.nan)
    low, high = np.nanpercentile(finite, (0, 99))
    axes.imshow(finite, cmap=_GROUND, vmin=min(1.0, float(low)), vmax=float(high))
    axes.imshow(np.where(np.isfinite(pace), np.nan, 1.0), cmap=_WALL)


def draw_route(axes: Axes, trail: NDArray[Any], colour: str, label: str | None = None) -> None:
    """Draws a line through (n, 2) places; a label is for the legend."""
    axes.plot(trail[:, 1], trail[:, 0], color="white", lw=3.6, solid_capstyle="round")
    axes.plot(trail[:, 1], trail[:, 0], color=colour, lw=2.1, label=label)


def draw_target(axes: Axes, place: Place, colour: str = RED) -> None:
    """Draws a target as a star."""
    axes.plot(place[1], place[0], "*", ms=15, color=colour, mec="white", mew=1.0, zorder=5)


def _draw_chase(axes: Axes, trail: Trail, vehicle: Place, target: Place, colour: str = GREEN) -> None:
    draw_route(axes, trail, colour)
    axes.plot(vehicle[1], vehicle[0], "o", ms=8, color=GREEN, mec="white", mew=1.2)
    draw_target(axes, target)


def draw_named(pictures: Mapping[str, Callable[[], Figure]]) -> None:
    """Writes the pictures which the command line names, all if none.

    A file has a palette and neither date nor version: the same picture is the same file.
    """
    parser = argparse.ArgumentParser(description="Draw pictures of the documentation.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(pictures)}; all if none")
    for name in parser.parse_args().names or pictures:
        raw = io.BytesIO()
        with mpl.rc_context(fname=Path(__file__).parents[2] / "launch_scripts/report/pictures.mplstyle"):
            pictures[name]().savefig(raw, format="png", dpi=100, metadata={"Software": None})
        image = Image.open(raw).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        image.save(IMAGES / f"{name}.png", optimize=True)


PICTURES: dict[str, Callable[[], Figure]] = {
    "method/tree": tree,
    "method/reversed-edges": reversed_edges,
    "method/range-rule": range_rule,
    "method/tracking": tracking,
    "method/schedule": schedule,
    "method/strides": strides,
}
"""Picture, by its place below docs/images without .png -> what draws it."""

if __name__ == "__main__":
    draw_named(PICTURES)
