"""What a study found: each outcome of each case with its interval, and the trials in which a law broke."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from launch_scripts.simulation.study import statistics
from launch_scripts.simulation.study.plan import PlannedCase
from launch_scripts.simulation.study.statistics import Estimate
from launch_scripts.simulation.study.study import Study
from launch_scripts.simulation.study.trial import Result, Trial
from launch_scripts.simulation.trial import SECONDS

OUTCOMES = {False: ("captures", "marks", "routes_served"), True: ("captures", "longest_wait_s", "routed_after_s")}
"""With faults or without: what is told where a study names no outcomes."""


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """A figure over the seeds of a case.

    values      seed -> value, of the trials that have it
    difference  from the first case of the same scenario, seed by seed; None of that one
    """

    values: dict[int, float]
    mean: Estimate | None
    median: Estimate | None
    difference: Estimate | None


class CaseSummary(msgspec.Struct, frozen=True, kw_only=True):
    """A case: how many of its trials have a result, how many broke a law, and its outcomes."""

    scenario: str
    label: str
    trials: int
    broken: int
    share_broken: Estimate | None
    outcomes: dict[str, Outcome]


class Failure(msgspec.Struct, frozen=True, kw_only=True):
    """A trial that broke laws, and the command that runs it again."""

    scenario: str
    label: str
    seed: int
    laws: list[str]
    sentences: list[str]
    replay: str


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """A study, whole.

    missing  trials without a result: their worker died each time
    """

    study: str
    about: str
    trials: int
    missing: int
    simulated_s: float
    cpu_s: float
    cases: list[CaseSummary]
    failing: list[Failure]


def summarise(
    study: Study, planned: Sequence[PlannedCase], results: Mapping[str, Result], files: Mapping[int, str]
) -> Summary:
    """The summary of all results that are there.

    results  key of a trial -> result
    files    number of a case -> what `swarm simulate` is to run instead of the scenario that the study names
    """
    names = study.outcomes or OUTCOMES[study.faults]
    cases, failing = [], []
    first: dict[str, dict[str, dict[int, float]]] = {}
    for number, each in enumerate(planned):
        pairs = [(trial, results[trial.key]) for trial in each.trials if trial.key in results]
        values = {name: values_of(name, pairs) for name in names}
        base = first.setdefault(each.case.scenario, values)
        failures = [
            _failure(each, trial, result, files.get(number, each.path)) for trial, result in pairs if result.broken
        ]
        cases.append(
            CaseSummary(
                scenario=each.case.scenario,
                label=each.case.label,
                trials=len(pairs),
                broken=len(failures),
                share_broken=statistics.share(len(failures), len(pairs)) if pairs else None,
                outcomes={
                    name: _outcome(found, None if base is values else base[name]) for name, found in values.items()
                },
            )
        )
        failing += failures
    every = [trial for each in planned for trial in each.trials]
    there = [trial for trial in every if trial.key in results]
    return Summary(
        study=study.name,
        about=study.about,
        trials=len(every),
        missing=len(every) - len(there),
        simulated_s=sum(trial.seconds for trial in there),
        cpu_s=sum(results[trial.key].cpu_s for trial in there),
        cases=cases,
        failing=failing,
    )


def values_of(name: str, pairs: Sequence[tuple[Trial, Result]]) -> dict[int, float]:
    """Seed -> a figure, of the trials that have it."""
    return {trial.seed: result.figures[name] for trial, result in pairs if name in result.figures}


def _outcome(values: dict[int, float], base: Mapping[int, float] | None) -> Outcome:
    numbers = list(values.values())
    differences = [] if base is None else [value - base[seed] for seed, value in values.items() if seed in base]
    return Outcome(
        values=values,
        mean=statistics.mean(numbers) if numbers else None,
        median=statistics.median(numbers) if numbers else None,
        difference=statistics.mean(differences) if differences else None,
    )


def _failure(each: PlannedCase, trial: Trial, result: Result, runs: str) -> Failure:
    name = trial.world if each.scenario is None else shlex.quote(runs)
    usual_s = SECONDS if trial.faults or each.scenario is None else each.scenario.seconds
    seed = f"--seeds {trial.seed}:{trial.seed + 1}" if trial.faults else f"--seed {trial.seed}"
    seconds = "" if trial.seconds == usual_s else f" --seconds {trial.seconds:g}"
    return Failure(
        scenario=each.case.scenario if each.scenario is not None else trial.world,
        label=each.case.label,
        seed=trial.seed,
        laws=list(dict.fromkeys(law.law for law in result.broken)),
        sentences=[law.sentence for law in result.broken],
        replay=f"swarm simulate {name} {seed}{seconds}",
    )


def as_json(summary: Summary) -> dict[str, Any]:
    told: dict[str, Any] = msgspec.to_builtins(summary, str_keys=True)
    return told
