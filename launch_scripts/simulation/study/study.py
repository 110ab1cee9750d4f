"""A study: which scenarios are simulated, with which settings and seeds. Read from a TOML file and checked."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from launch_scripts.simulation.campaign import MIX, parse_seeds
from launch_scripts.simulation.worlds import WORLDS
from swarm.config.explain import choice, explain
from swarm.config.input_files import FileKind, parse_toml, quoted, read_text
from swarm.config.load import flat
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
