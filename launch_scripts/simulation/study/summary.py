"""The findings of a study: each outcome of each case with its interval, and the trials in which a law broke."""

from __future__ import annotations

import math
import shlex
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
from scipy import stats

from launch_scripts.simulation.study.study import Case, Study
from launch_scripts.simulation.trials import SECONDS, Result, Trial, replay_of

LEVEL = 0.95
"""Confidence of all intervals: the usual one."""
MOST_BOOTSTRAPPED = 1000
"""Above this number of values the mean is practically normal, and Student's t gives the same result without
delay."""
_RESAMPLES = 9999
"""SciPy's default."""
_SAME = 1e-12
"""Values that differ by less, relative to the largest, are one: rounding."""
METHOD = (
    f"Intervals hold with 95 %: of means BCa bootstrap ({_RESAMPLES:,} resamples; Student's t above "
    f"{MOST_BOOTSTRAPPED:,} values), of medians order statistics, which assume nothing, of shares Wilson's. Of one "
    "or two values, and of medians of fewer than six, there is none. Differences are of the same seeds."
)


class Estimate(msgspec.Struct, frozen=True):
    """A value, and the interval that holds it; None where there are too few values to tell."""

    value: float
    low: float | None = None
    high: float | None = None


def _between(value: float, ends: Any) -> Estimate:
    """An estimate whose interval has both ends, or none."""
    low, high = map(float, ends)
    return Estimate(value, low, high) if math.isfinite(low) and math.isfinite(high) else Estimate(value)


def mean(values: Sequence[float]) -> Estimate | None:
    """The mean; None of no values. The bootstrap draws by a fixed seed: the same values give the same interval."""
    data = np.asarray(values, np.float64)
    if not len(data):
        return None
    middle = float(data.mean())
    if len(data) < 3:
        return Estimate(middle)
    if np.ptp(data) <= _SAME * np.abs(data).max():
        return Estimate(middle, middle, middle)
    if len(data) > MOST_BOOTSTRAPPED:
        return _between(middle, stats.t.interval(LEVEL, len(data) - 1, middle, stats.sem(data)))
    # Values at the limits of floats have no interval.
    with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore", category=stats.DegenerateDataWarning):
        chance = np.random.default_rng(0)
        found = stats.bootstrap((data,), np.mean, n_resamples=_RESAMPLES, rng=chance, batch=1000)
    return _between(middle, found.confidence_interval)


def median(values: Sequence[float]) -> Estimate | None:
    """The median, between two of the values, by order statistics; None of no values."""
    if not len(values):
        return None
    found = stats.quantile_test(values, p=0.5).confidence_interval(LEVEL)
    return _between(float(np.median(values)), found)


def share(hits: int, count: int) -> Estimate:
    """The share of hits, by Wilson's interval."""
    found = stats.binomtest(hits, count).proportion_ci(LEVEL, "wilson")
    return Estimate(hits / count, float(found.low), float(found.high))


OUTCOMES = {False: ("captures", "marks", "routes_served"), True: ("captures", "longest_wait_s", "routed_after_s")}
"""Outcomes, with faults or without, of a study that names none."""


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


def name_of(case: Case, trial: Trial) -> str:
    """The scenario of a trial, or its small world."""
    return trial.world if case.given is None else case.scenario


def summarise(study: Study, cases: Sequence[Case], results: Mapping[str, Result]) -> Summary:
    """The summary of all results that are there.

    results  key of a trial -> result
    """
    summaries: list[CaseSummary] = []
    failing: list[Failure] = []
    first: dict[str, dict[str, dict[int, float]]] = {}
    for case in cases:
        pairs = [(trial, results[trial.key]) for trial in case.trials if trial.key in results]
        values = {
            name: {trial.seed: result.figures[name] for trial, result in pairs if name in result.figures}
            for name in study.outcomes or OUTCOMES[study.faults]
        }
        base, outcomes = first.setdefault(case.scenario, values), {}
        for name, found in values.items():
            numbers = list(found.values())
            apart = [value - base[name][seed] for seed, value in found.items() if seed in base[name]]
            difference = None if base is values else mean(apart)
            outcomes[name] = Outcome(
                values=found, mean=mean(numbers), median=median(numbers), difference=difference
            )
        failures = [_failure(case, trial, result) for trial, result in pairs if result.broken]
        failing += failures
        summaries.append(
            CaseSummary(
                scenario=case.scenario,
                label=case.label,
                trials=len(pairs),
                broken=len(failures),
                share_broken=share(len(failures), len(pairs)) if pairs else None,
                outcomes=outcomes,
            )
        )
    every = [trial for case in cases for trial in case.trials]
    there = [trial for trial in every if trial.key in results]
    return Summary(
        study=study.name,
        about=study.about,
        trials=len(every),
        missing=len(every) - len(there),
        simulated_s=sum(trial.seconds for trial in there),
        cpu_s=sum(results[trial.key].cpu_s for trial in there),
        cases=summaries,
        failing=failing,
    )


def _failure(case: Case, trial: Trial, result: Result) -> Failure:
    usual_s = SECONDS if trial.faults or case.given is None else case.given.seconds
    runs = trial.world if case.given is None else shlex.quote(case.path)
    return Failure(
        scenario=name_of(case, trial),
        label=case.label,
        seed=trial.seed,
        laws=list(dict.fromkeys(law.law for law in result.broken)),
        sentences=[law.sentence for law in result.broken],
        replay=replay_of(runs, trial.seed, trial.seconds, usual_s, "seeds" if trial.faults else "seed"),
    )


# --- as tables ---------------------------------------------------------------------------------------------------


def outcome_table(summary: Summary, name: str) -> str:
    """A row for each case: an outcome, and by what it differs from that of the first case."""
    rows = []
    for case in summary.cases:
        outcome = case.outcomes[name]
        told = (*_cells(outcome.mean), *_cells(outcome.median), *_cells(outcome.difference, "+"))
        rows.append((case.scenario, case.label, str(len(outcome.values)), *told))
    headings = ("scenario", "case", "n", "mean", "95 %", "median", "95 %", "to the first case", "95 %")
    widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
    first, *rest = (f"| {' | '.join(map(str.ljust, row, widths))} |" for row in (headings, *rows))
    return "\n".join([first, f"|{'|'.join('-' * (width + 2) for width in widths)}|", *rest])


def _number(value: float | None, sign: str = "") -> str:
    """Returns four significant digits, all digits of numbers of 1,000 or more."""
    if value is None:
        return "-"
    value = value + 0.0  # no minus zero
    return f"{value:{sign},.0f}" if abs(value) >= 1000 else f"{value:{sign}.4g}"


def _cells(estimate: Estimate | None, sign: str = "") -> tuple[str, str]:
    """A value, and the two ends of its interval."""
    if estimate is None:
        return "-", "-"
    low, high = _number(estimate.low, sign), _number(estimate.high, sign)
    return _number(estimate.value, sign), "-" if estimate.low is None else f"{low} to {high}"
