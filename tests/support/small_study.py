"""A study of short trials: a hill with ten vehicles, as a scenario in a file of its own."""

import os
import signal
from pathlib import Path

from launch_scripts.simulation.trials import Result, Trial, run_trial

SCENARIO = """
name = "hill"
seconds = 3
time_scale = 10
terrain = { source = "synthetic", rows = 32, cols = 32, resolution_m = 30, hidden = { rubble_fields = 3 } }
targets = [{ count = 2, speed_m_per_s = 3 }]
groups = [{ vehicles = 6 }]
vehicles = { per_agent = 3, sense_range_m = 120, capture_range_m = 60 }
"""
STUDY = """
scenarios = ["hill.toml"]
seeds = "0:3"
outcomes = ["captures", "marks", "by_group.all.distance_m"]
[parameters]
vehicles.sense_range_m = [60, 120]
"""


def dies_of_seed_one(trial: Trial) -> Result:
    """Like `run_trial`, but the process ends by one of the seeds."""
    if trial.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return run_trial(trial)


def write_study(folder: Path, text: str = STUDY) -> Path:
    """The file of a study, beside its scenario."""
    (folder / "hill.toml").write_text(SCENARIO, encoding="utf-8")
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    return path
