"""Where targets are believed to be that nobody sees: what is drawn of it. No rerun, no bus, no clock."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from launch_scripts.monitor.ground.terrain_mesh import Bytes, Floats, TerrainMesh
from launch_scripts.monitor.movers.looks import SEARCHED_COLOUR
from swarm.clock import NS_PER_S
from swarm.wire.fields import column
from swarm.wire.messages.planning import Believed

SILENT_NS = 5 * NS_PER_S
"""A planner that searches tells its belief once a second: what is older is drawn no more."""
_FAINT, _FULL = 40, 235


class Searches:
    """The newest belief about each target."""

    def __init__(self) -> None:
        self._of: dict[str, tuple[Believed, int]] = {}
        self._changed = False

    def hear(self, believed: Believed, now_ns: int) -> None:
        """Take one in; without cells the search is over."""
        self._changed = True
        if believed.cells:
            self._of[believed.target] = (believed, now_ns)
        else:
            self._of.pop(believed.target, None)

    def draw_anew(self) -> None:
        """All of it is drawn once more."""
        self._changed = True

    def take_changed(self, now_ns: int) -> Mapping[str, Believed] | None:
        """Target -> what is believed; None if that is the same as before."""
        silent = [id for id, (_, heard_ns) in self._of.items() if now_ns - heard_ns >= SILENT_NS]
        for id in silent:
            del self._of[id]
        if not self._changed and not silent:
            return None
        self._changed = False
        return {id: believed for id, (believed, _) in self._of.items()}


def searched_points(mesh: TerrainMesh, beliefs: Mapping[str, Believed]) -> tuple[Floats, Bytes, Floats, list[str]]:
    """Places float32 (n, 3), colours uint8 (n, 4), the likelier the less transparent, radii float32 (n,), m, and a
    sentence about each. Cells outside of the map are left out."""
    places, colours, radii_m = [], [], []
    details: list[str] = []
    grid = mesh.grid
    for believed in beliefs.values():
        cells = np.array(believed.cells, np.int64)
        shares = column(believed.shares, "<f4")
        on_map = (cells >= 0) & (cells < grid.cells)
        cells, shares = cells[on_map], shares[on_map]
        rows, cols = np.divmod(cells, grid.cols)
        east_m, south_m = (((each + 0.5) * grid.resolution_m).astype(np.float32) for each in (cols, rows))
        places.append(mesh.place(east_m, south_m, 0.1 * mesh.scale_m))
        opaque = np.sqrt(shares / max(float(shares.max(initial=0.0)), 1e-12))
        colour = np.empty((len(cells), 4), np.uint8)
        colour[:, :3] = SEARCHED_COLOUR
        colour[:, 3] = _FAINT + (_FULL - _FAINT) * opaque
        colours.append(colour)
        details += [f"{believed.target} may be here: {share:.1%}" for share in shares.tolist()]
        radii_m.append(np.full(len(cells), 0.4 * believed.side_m, np.float32))
    if not places:
        return np.zeros((0, 3), np.float32), np.zeros((0, 4), np.uint8), np.zeros(0, np.float32), []
    return np.concatenate(places), np.concatenate(colours), np.concatenate(radii_m), details
