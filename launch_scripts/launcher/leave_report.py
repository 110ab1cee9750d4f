"""What a launcher prints and writes at the end of a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from launch_scripts.launcher.own_part import OwnPart
from launch_scripts.launcher.terminal import Terminal
from launch_scripts.observe.recorder import Recorder
from launch_scripts.process_table import RECORDED_BESIDE
from launch_scripts.report.write_report import make_report, write_report
from shared_map.arrays import Floats
from shared_map.terrain.terrain import Terrain

ELSEWHERE = f"the run is recorded and reported by the launcher that starts {RECORDED_BESIDE}"
"""Said by all others."""


def leave_report(
    known: Recorder | OwnPart,
    terminal: Terminal,
    folder: Path,
    ground: tuple[Terrain, Floats],
    *,
    as_json: bool,
    **measured: Any,
) -> None:
    """Prints the numbers of a run and writes its report. Of a part says where the report is. Raises StoreError.

    ground    the terrain, and the true pace of every cell
    measured  as `Recorder.report` takes it
    """
    if isinstance(known, OwnPart):
        if as_json:
            terminal.print_json(json.dumps(known.report(**measured), indent=2))
        else:
            terminal.say(f"{ELSEWHERE}; in {folder} are the logs of this machine's processes")
        return
    terrain, truth = ground
    report = make_report(known, terrain, **measured)
    numbers = {name: value for name, value in report.items() if name not in ("series", "by_vehicle")}
    if as_json:
        terminal.print_json(json.dumps(numbers, indent=2))
    else:
        terminal.report(numbers)
    # The figures come first: a full disk keeps nobody from them.
    write_report(folder, report, known, terrain, truth=truth)
