"""Shell completion for scenario, run, target, vehicle and group names, and for enumerations.

No function here may fail or take long: the user has pressed the Tab key. Unreadable files are not offered.
"""

from __future__ import annotations

import contextlib
import importlib
import typing
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from swarm.config.agents import AgentPlan
    from swarm.config.scenario import Scenario

Completion = Callable[[typer.Context, str], list[str]]


def scenarios(ctx: typer.Context, incomplete: str) -> list[str]:
    """Built-in scenarios, and .toml files below the folder that the word begins with."""
    from launch_scripts.launcher.options import SCENARIOS

    built_in = sorted(file.stem for file in SCENARIOS.glob("*.toml"))
    return [name for name in [*built_in, *_files(incomplete, ".toml")] if name.startswith(incomplete)]


def scenarios_and_worlds(ctx: typer.Context, incomplete: str) -> list[str]:
    """Like `scenarios`, and the small worlds of `swarm simulate --seeds`."""
    from launch_scripts.simulation.worlds import WORLDS

    return [*scenarios(ctx, incomplete), *(name for name in WORLDS if name.startswith(incomplete))]


def studies(ctx: typer.Context, incomplete: str) -> list[str]:
    """Built-in studies, and .toml files below the folder that the word begins with."""
    from launch_scripts.simulation.study.study import study_names

    return [name for name in [*study_names(), *_files(incomplete, ".toml")] if name.startswith(incomplete)]


def terrains(ctx: typer.Context, incomplete: str) -> list[str]:
    """Built-in terrains; files are the shell's own matter."""
    from swarm.config.load import BUILT_IN_TERRAINS

    return [name for name in BUILT_IN_TERRAINS if name.startswith(incomplete)]


def runs(ctx: typer.Context, incomplete: str) -> list[str]:
    """Names of the runs in --runs and of those that are registered, the newest first, and LAST."""
    from launch_scripts.observe.run_registry import registered

    names = {run.name for run in registered()}
    with contextlib.suppress(OSError):
        names |= {each.name for each in _runs_folder(ctx).iterdir() if each.is_dir()}
    return [name for name in sorted(names, reverse=True) if name.startswith(incomplete)]


def _ids(of: Callable[[Scenario], Iterable[str]]) -> Completion:
    """Names of the scenario that is named, or of the newest run."""

    def offered(ctx: typer.Context, incomplete: str) -> list[str]:
        scenario = _scenario(ctx)
        return [] if scenario is None else [id for id in of(scenario) if id.startswith(incomplete)]

    return offered


def _plans(scenario: Scenario) -> Sequence[AgentPlan]:
    from swarm.config.agents import plan_agents

    return plan_agents(scenario)


target_ids = _ids(lambda scenario: scenario.target_ids)
group_names = _ids(lambda scenario: [group.name for group in scenario.groups])
agent_ids = _ids(lambda scenario: [plan.id for plan in _plans(scenario)])
vehicle_ids = _ids(lambda scenario: [id for plan in _plans(scenario) for id in plan.vehicle_ids])


def words(module: str, name: str) -> Completion:
    """The words of a constant: a sequence, a mapping or a `Literal`. Its module is imported on the Tab key."""

    def offered(ctx: typer.Context, incomplete: str) -> list[str]:
        known: Any = getattr(importlib.import_module(module), name)
        return [str(word) for word in typing.get_args(known) or tuple(known) if str(word).startswith(incomplete)]

    return offered


def _files(incomplete: str, ending: str) -> Iterator[str]:
    folder = Path(incomplete) if incomplete.endswith("/") else Path(incomplete).parent
    before = "" if "/" not in incomplete else incomplete[: incomplete.rfind("/") + 1]
    with contextlib.suppress(OSError):
        for each in sorted(folder.iterdir()):
            if each.suffix == ending:
                yield f"{before}{each.name}"
            elif each.is_dir() and not each.name.startswith("."):
                yield f"{before}{each.name}/"


def _runs_folder(ctx: typer.Context) -> Path:
    return Path(ctx.params.get("runs") or "runs")


def _scenario(ctx: typer.Context) -> Scenario | None:
    """The scenario that the command line names, or else that of the newest run here."""
    from launch_scripts.launcher.options import find_scenario
    from launch_scripts.observe.run_folder import LAST, SCENARIO_FILE, find_run
    from swarm.errors import SwarmError

    # While an option still lacks its value, the words before it are left as they are.
    name = next((word for word in ctx.args if not word.startswith("-")), ctx.params.get("scenario"))
    with contextlib.suppress(SwarmError, OSError):
        return find_scenario(name or str(find_run(LAST, _runs_folder(ctx)) / SCENARIO_FILE))
    return None
