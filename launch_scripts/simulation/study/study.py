"""A study: which scenarios are simulated, with which settings and seeds.

Read from a TOML file, checked, and planned: each case becomes a scenario and its trials, each with a key that says
all that its result depends on.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from launch_scripts.deploy.host_scenario import parts_of, plugin_files
from launch_scripts.launcher.options import SCENARIOS, scenario_path
from launch_scripts.simulation.campaign import MIX, parse_seeds, world_of
from launch_scripts.simulation.study.trials import Trial, code_version
from launch_scripts.simulation.trial import SECONDS
from launch_scripts.simulation.worlds import WORLDS
from swarm.config.explain import choice, explain
from swarm.config.input_files import FileKind, parse_toml, quoted, read_text
from swarm.config.load import flat, parse_scenario
from swarm.config.scenario import Scenario
from swarm.config.values import Name, Options, Positive, Section
from swarm.errors import ConfigError

MOST_TRIALS = 1_000_000
_LONGEST = 200
"""Letters of a name: pictures are called by it."""
_LONGEST_PATH = 4096
STUDIES = Path(__file__).parents[2] / "studies"
"""The project's own."""


class Study(Section, frozen=True, kw_only=True):
    """What is simulated.

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
    scenarios: Annotated[tuple[str, ...], Meta(min_length=1, max_length=1000)]
    seeds: str = "0:10"
    seconds: Positive | None = None
    faults: bool = False
    outcomes: tuple[str, ...] = ()
    parameters: Options = msgspec.field(default_factory=dict)
    variants: dict[str, Options] = msgspec.field(default_factory=dict)

    @property
    def seed_range(self) -> range:
        return parse_seeds(self.seeds, "seeds")


class Case(msgspec.Struct, frozen=True, kw_only=True):
    """A scenario with settings, of which each seed is a trial.

    scenario  as the study names it
    variant   its name; empty if the study has none
    label     what tables call it: the variant and the parameters
    settings  dotted key -> value, of both
    """

    scenario: str
    variant: str
    label: str
    settings: dict[str, Any]


def study_path(name: str) -> Path:
    """The file of a study of the project by its name, or the one named. Raises ConfigError where there is none."""
    built_in = STUDIES / f"{name}.toml"
    if "/" in name or is_file(Path(name)) or not is_file(built_in):
        if not name.endswith(".toml"):
            names = study_names()
            raise ConfigError(f"no study {quoted(name)}{choice(name, names, ' give a .toml file or one of: ')}")
        return Path(name)
    return built_in


def study_names() -> list[str]:
    """Of the project's own."""
    return sorted(file.stem for file in STUDIES.glob("*.toml"))


def load_study(path: Path) -> Study:
    """Read and check a study. Raises ConfigError that names the file and the key."""
    return parse_study(read_text(path, FileKind.STUDY), str(path), _name_of(path))


def _name_of(path: Path) -> str:
    """A name as studies have them, from that of a file."""
    return re.sub("[^A-Za-z0-9_.-]+", "-", path.stem).lstrip(".-")[:41] or "study"


def is_file(path: Path) -> bool:
    """Whether there is such a file; no file has a name that the system refuses."""
    with suppress(OSError, ValueError):
        return path.is_file()
    return False


def parse_study(text: str, source: str = "study", name: str = "study") -> Study:
    """As `load_study`, of a text.

    name  of the study if the text gives none
    """
    raw: dict[str, Any] = {"name": name, **parse_toml(text, source, ConfigError)}
    try:
        study = msgspec.convert(raw, Study)
    except msgspec.ValidationError as error:
        said = explain(str(error), raw, Study).replace("scenario: missing", "study: missing")
        raise ConfigError(f"{source}: {said}") from error
    try:
        _check(study)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    return study


def cases_of(study: Study) -> list[Case]:
    """Every scenario with every variant and every combination of parameters, in the order of the file."""
    parameters = dict(flat(study.parameters))
    variants: Mapping[str, dict[str, Any]] = {name: dict(flat(of)) for name, of in study.variants.items()}
    names = _short_names(parameters)
    return [
        Case(
            scenario=scenario,
            variant=variant,
            label=_label(variant, {names[key]: value for key, value in varied.items()}),
            settings={**settings, **varied},
        )
        for scenario in study.scenarios
        for variant, settings in (variants or {"": {}}).items()
        for values in itertools.product(*parameters.values())
        for varied in [dict(zip(parameters, values, strict=True))]
    ]


def _check(study: Study) -> None:
    """What the types do not say. Raises ConfigError."""
    count = len(study.seed_range) * len(study.scenarios) * max(1, len(study.variants))
    for key, values in flat(study.parameters):
        if not isinstance(values, list) or not values:
            raise ConfigError(f"parameters.{key}: found {quoted(values)}, expected a list of values")
        if (twice := _twice(values)) is not None:
            raise ConfigError(f"parameters.{key}: found {quoted(twice[0])} twice")
        count *= len(values)
    if count > MOST_TRIALS:
        raise ConfigError(f"it has {count:,} trials, expected at most {MOST_TRIALS:,}")
    for what, given in (("scenarios", study.scenarios), ("outcomes", study.outcomes)):
        if (same := _twice(given)) is not None:
            raise ConfigError(f"{what}: found {quoted(same[0])} twice")
    for what, names in (("scenarios", study.scenarios), ("outcomes", study.outcomes), ("variants", study.variants)):
        longest = _LONGEST_PATH if what == "scenarios" else _LONGEST
        for name in names:
            if not name.isprintable() or not 0 < len(name) <= longest:
                raise ConfigError(f"{what}: found {quoted(name)}, expected 1 to {longest} characters that print")
    if not study.about.replace("\n", "").isprintable():
        raise ConfigError(f"about: found {quoted(study.about)}, expected printable text")
    varied = dict(flat(study.parameters))
    for name, settings in study.variants.items():
        for key, _ in flat(settings):
            if key in varied:
                raise ConfigError(f"variants.{name}.{key}: it is one of the parameters, too")
    for name in _worlds(study):
        if not study.faults:
            raise ConfigError(f"scenarios: {name!r} is a small world, which goes with faults = true")
        if varied or any(study.variants.values()):
            raise ConfigError(f"scenarios: {name!r} is a small world, which takes no parameters and no variants")
    settled = {key for settings in study.variants.values() for key, _ in flat(settings)} | varied.keys()
    if "seed" in settled:
        raise ConfigError("seed: it is no setting of a study, whose `seeds` are those of each case")
    if "seconds" in settled and (study.faults or study.seconds is not None):
        raise ConfigError(
            "seconds: it does nothing where `faults` or `seconds` of the study say how long trials are"
        )


def _worlds(study: Study) -> Iterator[str]:
    return (name for name in study.scenarios if name in (MIX, *WORLDS))


def _twice(values: Iterable[Any]) -> tuple[Any] | None:
    """A value that is there twice. 1, 1.0 and true are three in TOML, as they are written."""
    seen: set[str] = set()
    for value in values:
        if (written := repr(value)) in seen:
            return (value,)
        seen.add(written)
    return None


def _short_names(keys: Iterable[str]) -> dict[str, str]:
    """The last part of each key, as far as that is no part of two."""
    last = {key: key.rpartition(".")[2] for key in keys}
    many = Counter(last.values())
    return {key: name if many[name] == 1 else key for key, name in last.items()}


def _label(variant: str, varied: Mapping[str, Any]) -> str:
    parts = [variant] if variant else []
    for name, value in varied.items():
        text = value if isinstance(value, str) and value.isprintable() else quoted(value)
        parts.append(f"{name} = {text if len(text) <= 40 else f'{text[:37]}...'}")
    return ", ".join(parts) or "as it is"


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
