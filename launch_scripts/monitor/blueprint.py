"""Layout of the live view."""

from __future__ import annotations

import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn

from launch_scripts.monitor.ground.terrain_mesh import TerrainMesh
from launch_scripts.monitor.movers.levels import level_for
from launch_scripts.monitor.movers.mover_drawing import mover_overrides

BACKGROUND = (17, 22, 28)


def make_blueprint(mesh: TerrainMesh, vehicles: int = 100) -> rrb.Blueprint:
    """The 3D view on the left; figures, plots and the log on the right.

    vehicles  how many there are, which decides how much is drawn of each
    """
    return rrb.Blueprint(
        rrb.Horizontal(
            _view_3d(mesh, vehicles),
            rrb.Vertical(
                rrb.TextDocumentView(origin="/summary", name="Now"),
                _plot("captures_and_marks", "Captures and marks"),
                _plot("gap", "Gap to optimum of each target, %", legend=False),
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


def _view_3d(mesh: TerrainMesh, vehicles: int) -> rrb.Spatial3DView:
    middle = (mesh.width_m / 2, -mesh.depth_m / 2, float(mesh.heights_m.mean()))
    far = max(mesh.width_m, mesh.depth_m)
    return rrb.Spatial3DView(
        origin="/world",
        name="Swarm",
        background=rrb.Background(color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=(middle[0] - 0.06 * far, middle[1] - 0.84 * far, middle[2] + 0.7 * far),
            look_target=(middle[0], middle[1] - 0.125 * far, middle[2]),
            eye_up=(0, 0, 1),
        ),
        overrides=mover_overrides(level_for(vehicles)),
    )


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
