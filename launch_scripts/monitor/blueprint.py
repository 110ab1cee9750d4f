"""Layout of the live view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn

from launch_scripts.monitor.ground.ground_view import said_heights
from launch_scripts.monitor.ground.legend import BACKGROUND, HEIGHT_PX, PHOTO, WIDTH_PX, Layer
from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.movers.map_lines import screen
from launch_scripts.monitor.movers.movers_view import FOLLOWED_ENTITY
from launch_scripts.monitor.movers.styles import HINT, Level, level_for


def make_blueprint(
    mesh: TerrainMesh, shown: Sequence[Layer] = (PHOTO,), *, vehicles: int = 100, follow: str | None = None
) -> rrb.Blueprint:
    """Layers of the 3D view on the left, each with its legend; figures, plots and the log on the right.

    vehicles  how many there are, which decides how much is drawn of each
    follow    vehicle or target that the camera follows
    """
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(*(_layer(mesh, layer, vehicles, follow) for layer in shown), active_tab=0),
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
        eye, look = (-0.02 * far, -0.16 * far, 0.11 * far), (0.0, 0.0, 0.0)
    else:
        east, north, up = mesh.width_m / 2, -mesh.depth_m / 2, float(mesh.heights_m.mean())
        eye, look = (east - 0.05 * far, north - 0.84 * far, up + 0.62 * far), (east, north - 0.19 * far, up)
    return rrb.Spatial3DView(
        origin=f"/{FOLLOWED_ENTITY}" if follow else "/world",
        contents=contents,
        name=", ".join((layer.title, said_heights(mesh.stretch), f"following {follow}" if follow else HINT)),
        background=rrb.Background(color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=look, eye_up=(0, 0, 1)
        ),
        overrides=_sizes(level_for(vehicles)),
    )


def _sizes(level: Level) -> dict[Any, Any]:
    """Radii of what moves, and how long trails are seen."""
    trail = rr.VisibleTimeRange(
        "sim_time",
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-level.trail_s),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    px = {"vehicles": level.radius_px, "guests": 0.8 * level.radius_px, "targets/balls": 8.5, "bodies/names": 3.0}
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
    columns = [
        TextLogColumn("EntityPath", visible=False),
        TextLogColumn("LogLevel", visible=True),
        TextLogColumn("Body", visible=True),
    ]
    return rrb.TextLogView(
        origin="/log",
        name="Log",
        columns=rrb.TextLogColumns(text_log_columns=columns, timeline_columns=["sim_time"]),
    )
