"""From a study to its trials: scenarios read with their settings, and a key for each result."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

from launch_scripts.deploy.host_scenario import parts_of, plugin_files
from launch_scripts.launcher.options import SCENARIOS, scenario_path
from launch_scripts.simulation.campaign import MIX, world_of
from launch_scripts.simulation.study.code_version import code_version
from launch_scripts.simulation.study.study import Case, Study, cases_of, is_file
from launch_scripts.simulation.study.trial import Trial
from launch_scripts.simulation.trial import SECONDS
from launch_scripts.simulation.worlds import WORLDS
from swarm.config.input_files import FileKind, read_text
from swarm.config.load import parse_scenario
from swarm.config.scenario import Scenario
from swarm.errors import ConfigError

_BYTES = 12


class PlannedCase(msgspec.Struct, frozen=True, kw_only=True):
    """A case, the scenario that it means, and its trials.

    path      of the scenario's file as the study names it, or its built-in name; that of a small world
    scenario  None: of a small world
    """

    case: Case
    path: str
    scenario: Scenario | None
    trials: list[Trial]


def plan(study: Study, base: Path, source: str) -> list[PlannedCase]:
    """The trials of a study. Raises ConfigError on a scenario that cannot be read, or not with these settings.

    base    folder of the study, beside which its scenarios lie
    source  what errors call the study
    """
    return [_planned(study, case, base, source) for case in cases_of(study)]


def _planned(study: Study, case: Case, base: Path, source: str) -> PlannedCase:
    path, scenario = (case.scenario, None) if case.scenario in (MIX, *WORLDS) else _scenario(case, base, source)
    seconds = study.seconds or (SECONDS if study.faults or scenario is None else scenario.seconds)
    version = code_version()
    settled = "" if scenario is None else _digest(_settings(scenario))
    trials = []
    for seed in study.seed_range:
        world = world_of(case.scenario, seed) if scenario is None else scenario.name
        key = _digest([version, world, settled, seed, seconds, study.faults])
        trials.append(
            Trial(
                key=key,
                world=world,
                scenario=scenario,
                seed=seed,
                seconds=seconds,
                faults=study.faults,
                version=version,
            )
        )
    return PlannedCase(case=case, path=path, scenario=scenario, trials=trials)


def _scenario(case: Case, base: Path, source: str) -> tuple[str, Scenario]:
    """Path or name of a case's scenario, and the scenario. One beside the study goes before a built-in one."""
    beside = base / case.scenario
    path = beside if is_file(beside) else scenario_path(case.scenario)
    name = case.scenario if path.parent == SCENARIOS else str(path)
    where = f"{source}: {name} with {case.label}" if case.settings else name
    text = read_text(path, FileKind.SCENARIO)
    return name, parse_scenario(text, where, path.parent.absolute(), case.settings)


def _settings(scenario: Scenario) -> Any:
    """All that a scenario says but its seed and seconds, which a trial has of its own; the content of a file
    instead of its place."""
    settings = msgspec.to_builtins(scenario)
    del settings["seed"], settings["seconds"]
    settings["plugin_folder"] = _plugins(scenario)
    return _with_content(settings)


def _with_content(value: Any) -> Any:
    match value:
        case dict():
            return {key: _with_content(each) for key, each in value.items()}
        case list() | tuple():
            return [_with_content(each) for each in value]
        case str() if value.startswith("/") and Path(value).is_file():
            return {"file": [_file_digest(str(path)) for path in (Path(value), *parts_of(Path(value)))]}
    return value


def _plugins(scenario: Scenario) -> dict[str, str]:
    return {place: _file_digest(str(path)) for place, path in plugin_files(scenario).items()}


@cache
def _file_digest(path: str) -> str:
    digest = hashlib.blake2b(digest_size=_BYTES)
    try:
        with Path(path).open("rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror or error}") from error
    return digest.hexdigest()


def _digest(value: Any) -> str:
    encoded = msgspec.json.encode(value, order="deterministic")
    return hashlib.blake2b(encoded, digest_size=_BYTES).hexdigest()


def trials_of(planned: list[PlannedCase]) -> Iterator[Trial]:
    return (trial for each in planned for trial in each.trials)
