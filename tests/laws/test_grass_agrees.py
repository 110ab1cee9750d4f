"""GRASS, a foreign engine, on the same ground: `r.cost` under its convention, `r.walk` beside Langmuir's rule."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.kernel_oracle import grown, inner, loaded
from support.slow_twins import cost_to_go

from shared_map.terrain.slope_and_climb import directional_factor
from swarm.config.ground import CostConfig

pytestmark = pytest.mark.skipif(shutil.which("grass") is None, reason="needs GRASS: apt-get install grass-core")
SIDE_M = 10.0
S_PER_M, PER_CLIMB, PER_DESCENT = 0.72, 6.0, 1.9998
"""Its settings as they are by default: 5 km/h, and seconds of a metre up or down."""


def written(path: Path, values: NDArray[np.float32]) -> None:
    rows, cols = values.shape
    head = f"north: {rows * SIDE_M}\nsouth: 0\neast: {cols * SIDE_M}\nwest: 0\nrows: {rows}\ncols: {cols}\n"
    text = "\n".join(" ".join(f"{v:.9g}" if np.isfinite(v) else "*" for v in row) for row in values)
    path.write_text(head + text + "\n")


def grass(folder: Path, maps: dict[str, NDArray[np.float32]], command: str) -> NDArray[np.float64]:
    """The map `out` after a command of GRASS on some maps; NaN where it has no value."""
    script = ["set -e"]
    for name, values in maps.items():
        written(folder / f"{name}.txt", values)
        script += [f"r.in.ascii --quiet input={folder}/{name}.txt output={name}", f"g.region raster={name}"]
    script += [
        command,
        f"r.out.ascii --quiet --overwrite input=out output={folder}/out.txt precision=15 null_value=nan",
    ]
    ran = ["grass", "--tmp-location", "XY", "--exec", "sh", "-c", "\n".join(script)]
    done = subprocess.run(ran, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return np.loadtxt(folder / "out.txt", skiprows=6)


def test_costs_to_go_equal_those_of_grass_on_the_same_file(tmp_path: Path) -> None:
    """A step of ours has the pace of the cell that it enters, one of GRASS the mean of both of its cells: with
    equal paces they are one convention, and else the same search under either of them is compared."""
    rng = np.random.default_rng(5)
    rough = np.exp(rng.normal(0, 1.2, (60, 70))).astype(np.float32)
    rough[rng.random(rough.shape) < 0.15] = np.inf
    even = np.where(np.isfinite(rough), np.float32(0.7), np.float32(np.inf))
    row, col = map(int, np.argwhere(np.isfinite(rough))[2000])
    root = row * rough.shape[1] + col
    at = f"start_coordinates={(col + 0.5) * SIDE_M},{(rough.shape[0] - row - 0.5) * SIDE_M}"
    for pace in (even, rough):
        theirs = grass(tmp_path, {"pace": pace}, f"r.cost --quiet input=pace output=out {at}")
        mean = cost_to_go(pace, root, corner_cutting=True, left_share=0.5)
        there = np.isfinite(pace) & np.isfinite(mean)
        assert there.sum() > 3000
        np.testing.assert_allclose(theirs[there], mean[there], rtol=1e-4)
        tree = grown(loaded(pace, corner_cutting=True), root)
        entered = theirs if pace is even else cost_to_go(pace, root, corner_cutting=True)
        np.testing.assert_allclose(inner(tree, tree.cost)[there], entered[there], rtol=1e-4)


@pytest.mark.parametrize("slope_deg", [-20, -13, -11, -6, -3, 0, 4, 15])
def test_a_walk_takes_what_langmuir_says(tmp_path: Path, slope_deg: int) -> None:
    """Below 5 degrees a descent saves a walker no time by the book; GRASS has no such limit."""
    rise = np.tan(np.radians(slope_deg))
    plane = np.float32(500 + np.arange(30) * SIDE_M * rise)[None]  # one row: a walker would go across a slope
    command = (
        "r.walk --quiet elevation=plane friction=none output=out"
        f" start_coordinates={SIDE_M / 2},{SIDE_M / 2} lambda=0"
    )
    theirs = grass(tmp_path, {"plane": plane, "none": np.zeros_like(plane)}, command)[-1]
    factor = directional_factor(np.array([rise], np.float32), CostConfig(slope_rule="naismith_langmuir"))[0]
    ours = 29 * SIDE_M * S_PER_M * float(factor)
    bonus = 29 * SIDE_M * -rise * PER_DESCENT if -5 < slope_deg < 0 else 0.0
    assert theirs + bonus == pytest.approx(ours, rel=2e-4)
