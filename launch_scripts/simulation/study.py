"""A study, scenarios x settings x seeds through the simulation: its file, its trials, and its findings.

The TOML file of a study is read, checked and planned: each case becomes a scenario and its trials, each with a key
that is a digest of all that decides the result. `study_sweep` runs those that are missing. The findings are each
outcome of each case with its interval, and the trials in which a law broke.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import os.path
import re
import shlex
import textwrap
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from scipy import stats

from launch_scripts.deploy.machine_archives import parts_of, plugin_files
from launch_scripts.launcher.run_options import SCENARIOS, scenario_path
from launch_scripts.simulation.sample_worlds import WORLDS
from launch_scripts.simulation.trials import (
    MIX,
    SECONDS,
    Result,
    Trial,
    code_version,
    parse_seeds,
    replay_of,
    world_of,
)
from swarm.config.explain import choice, converted
from swarm.config.input_files import FileKind, parse_toml, quoted, read_text
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import flat, parse_scenario
from swarm.config.setting_types import Name, Options, Positive, Section
from swarm.errors import ConfigError

MOST_TRIALS = 1_000_000
"""A larger number is a slip. Chosen, not measured."""
SMALL_WORLDS = (MIX, *WORLDS)
STUDIES = Path(__file__).parents[1] / "studies"
"""The project's own."""
Shown = Annotated[
    str, Meta(pattern=r"^[^\x00-\x1f\x7f-\x9f]{1,200}\Z", description="1 to 200 characters that print")
]
"""A name that tables show and pictures are called by."""
_hash = partial(hashlib.blake2b, digest_size=12)


class Study(Section, frozen=True, kw_only=True):
    """Cases and outcomes of a study.

    name        what the summary calls it; the file's name if not given
    about       what it asks, in a sentence, for the summary
    scenarios   built-in names, or files beside the study; with faults also the small worlds of `swarm simulate`,
                and "mix", which takes them in turn
    seeds       A:B is the seeds from A to B - 1, of each scenario with each setting
    seconds     simulated seconds of a trial; if not given those of the scenario, with faults 30
    faults      everything goes wrong at once, and each law is checked, as `swarm simulate --seeds` does
    outcomes    figures of the report that the summary tells, by dotted key, such as by_group.all.distance_m
    parameters  dotted keys of a scenario, each with a list of values: every combination is simulated
    variants    name -> settings of a scenario by dotted key; each with every combination of the parameters
    """

    name: Name = ""
    about: str = ""
    scenarios: Annotated[tuple[Shown, ...], Meta(min_length=1, max_length=1000)]
    seeds: str = "0:10"
    seconds: Positive | None = None
    faults: bool = False
    outcomes: tuple[Shown, ...] = ()
    parameters: Options = msgspec.field(default_factory=dict)
    variants: dict[Shown, Options] = msgspec.field(default_factory=dict)


class Case(msgspec.Struct, frozen=True):
    """A scenario with settings, of which each seed is a trial.

    scenario  as the study names it
    variant   its name; empty if the study has none
    label     what tables call it: the variant and the parameters
    settings  dotted key -> value, of both
    path      of the scenario's file as the study names it, or its built-in name; that of a small world
    given     the scenario that it means; None: that of a small world
    trials    planned of it
    """

    scenario: str
    variant: str
    label: str
    settings: dict[str, Any]
    path: str
    given: Scenario | None
    trials: tuple[Trial, ...]


def study_path(name: str) -> Path:
    """The file of a study of the project by its name, or the one named. Raises ConfigError where there is none."""
    if not name.endswith(".toml") and name not in study_names():
        raise ConfigError(f"no study {quoted(name)}{choice(name, study_names(), ' give a .toml file or one of: ')}")
    return Path(name) if name.endswith(".toml") else STUDIES / f"{name}.toml"


def study_names() -> list[str]:
    """Returns the names of the project's own studies."""
    return sorted(file.stem for file in STUDIES.glob("*.toml"))


def load_study(path: Path) -> Study:
    """Reads and checks a study. Raises ConfigError that names the file and the key."""
    name = re.sub("[^A-Za-z0-9_.-]+", "-", path.stem).lstrip(".-")[:41]
    return parse_study(read_text(path, FileKind.STUDY), str(path), name or "study")


def parse_study(text: str, source: str = "study", name: str = "study") -> Study:
    """Like `load_study`, from a text.

    name  of the study if the text gives none
    """
    raw: dict[str, Any] = {"name": name, **parse_toml(text, source, ConfigError)}
    study = converted(raw, Study, source, "study")
    seeds = parse_seeds(study.seeds, f"{source}: seeds")
    if wrong := next(_faults(study, len(seeds)), None):
        raise ConfigError(f"{source}: {wrong}")
    return study


def _faults(study: Study, seeds: int) -> Iterator[str]:
    """Returns faults of a study beyond those of its types, the most important first."""
    varied = dict(flat(study.parameters))
    settings = [(name, key) for name, of in study.variants.items() for key, _ in flat(of)]
    settled = {key for _, key in settings} | varied.keys()
    for key, values in varied.items():
        if not isinstance(values, list) or not values:
            yield f"parameters.{key}: found {quoted(values)}, expected a list of values"
    cases = math.prod(map(len, varied.values())) * len(study.scenarios) * max(1, len(study.variants))
    if cases * seeds > MOST_TRIALS:
        yield f"it has {cases * seeds:,} trials, expected at most {MOST_TRIALS:,}"
    for name, key in settings:
        if key in varied:
            yield f"variants.{name}.{key}: it is one of the parameters, too"
    for name in study.scenarios:
        if name in SMALL_WORLDS and not study.faults:
            yield f"scenarios: {name!r} is a small world, which goes with faults = true"
        if name in SMALL_WORLDS and settled:
            yield f"scenarios: {name!r} is a small world, which takes no parameters and no variants"
    if "seed" in settled:
        yield "seed: it is no setting of a study; `seeds` has the seeds of each case"
    if "seconds" in settled and (study.faults or study.seconds is not None):
        yield "seconds: it has no effect beside `faults` or `seconds` of the study, which set the length of trials"


def combinations(study: Study) -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Scenario, variant, label and settings of every case, in the order of the file."""
    parameters = dict(flat(study.parameters))
    last = Counter(key.rpartition(".")[2] for key in parameters)
    for scenario, (variant, of) in itertools.product(study.scenarios, (study.variants or {"": {}}).items()):
        for values in itertools.product(*parameters.values()):
            varied = dict(zip(parameters, values, strict=True))
            parts = [variant] if variant else []
            for key, value in varied.items():
                short = key.rpartition(".")[2]
                text = value if isinstance(value, str) and value.isprintable() else quoted(value)
                parts.append(f"{short if last[short] == 1 else key} = {textwrap.shorten(text, 40)}")
            yield scenario, variant, ", ".join(parts) or "as it is", {**dict(flat(of)), **varied}


def plan(study: Study, base: Path, source: str) -> list[Case]:
    """The cases of a study, with their trials. Raises ConfigError if a scenario cannot be read, or if the study's
    settings do not fit it.

    base    folder of the study file; a scenario in it is used instead of a built-in one of the same name
    source  name of the study in error messages
    """
    seeds, version, cases = parse_seeds(study.seeds, "seeds"), code_version(), []
    for name, variant, label, settings in combinations(study):
        path, given, settled = name, None, ""
        if name not in SMALL_WORLDS:
            file = base / name if os.path.isfile(base / name) else scenario_path(name)
            path = name if file.parent == SCENARIOS else str(file)
            where = f"{source}: {path} with {label}" if settings else path
            given = parse_scenario(read_text(file, FileKind.SCENARIO), where, file.parent.absolute(), settings)
            settled = _digest(_settings(given))
        seconds = study.seconds or (SECONDS if study.faults or given is None else given.seconds)
        trials = []
        for seed in seeds:
            world = world_of(name, seed) if given is None else given.name
            key = _digest([version, world, settled, seed, seconds, study.faults])
            trials.append(Trial(key, world, given, seed, seconds, study.faults, version))
        cases.append(Case(name, variant, label, settings, path, given, tuple(trials)))
    return cases


def _settings(scenario: Scenario) -> Any:
    """Returns all settings of a scenario but its seed and seconds, which a trial has of its own; the content of a
    file instead of its path."""
    settings = msgspec.to_builtins(scenario)
    del settings["seed"], settings["seconds"]
    settings["plugin_folder"] = {place: _file_digest(path) for place, path in plugin_files(scenario).items()}
    return _with_file_content(settings)


def _with_file_content(value: Any) -> Any:
    match value:
        case dict():
            return {key: _with_file_content(each) for key, each in value.items()}
        case list() | tuple():
            return [_with_file_content(each) for each in value]
        case str() if value.startswith("/") and Path(value).is_file():
            return {"file": [_file_digest(path) for path in (Path(value), *parts_of(Path(value)))]}
    return value


@cache
def _file_digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, _hash).hexdigest()
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror or error}") from error


def _digest(value: Any) -> str:
    return _hash(msgspec.json.encode(value, order="deterministic")).hexdigest()


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
        figures = (*_cells(outcome.mean), *_cells(outcome.median), *_cells(outcome.difference, "+"))
        rows.append((case.scenario, case.label, str(len(outcome.values)), *figures))
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
