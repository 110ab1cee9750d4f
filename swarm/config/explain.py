"""Meaning of each setting, from the rows of its section's docstring, and the values which its type allows, in
words.

Errors of a scenario are stated in these terms: the key, the value found, the values allowed, and a near name.
"""

from __future__ import annotations

import datetime
import difflib
import inspect
import os
import re
import types
import typing
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from swarm.config.input_files import quoted
from swarm.errors import ConfigError, SwarmError

T = TypeVar("T")

# --- what a setting means and may be ------------------------------------------------------------------------------

_ROW = re.compile(r"(\w+(?:, \w+)*) {2,}(\S.*)")
_WORDS = {str: "text in quotes", int: "a whole number", float: "a number", bool: "true or false"}
UNBOUNDED = 1e12
"""Limits beyond this keep numbers finite; they say nothing to a reader."""


def meanings(section: object) -> dict[str, str]:
    """Setting -> meaning, in the order of the rows of a section's docstring.

    A row is `key` or several, two or more spaces and the meaning; lines that begin with spaces continue it.
    """
    found: dict[str, str] = {}
    keys: list[str] = []
    for line in (inspect.getdoc(section) or "").splitlines():
        if row := _ROW.fullmatch(line):
            keys = row[1].split(", ")
            found |= dict.fromkeys(keys, row[2])
        elif line.startswith(" ") and keys:
            found |= {key: f"{found[key]} {line.strip()}" for key in keys}
        else:
            keys = []
    return found


@cache
def hints_of(section: Any) -> Mapping[str, Any]:
    """Setting, as a file names it -> its type, with its bounds."""
    hints = typing.get_type_hints(section, include_extras=True)
    if not is_section(section):
        return hints
    return {each.encode_name: hints[each.name] for each in msgspec.structs.fields(section)}


def expected(hint: Any) -> str:
    """Returns the values that a type allows, in words: "a whole number, 0 to 9"."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        bounds = [word for meta in args[1:] if isinstance(meta, msgspec.Meta) for word in bounds_of(meta)]
        return ", ".join([expected(args[0]), *bounds])
    if origin in (types.UnionType, typing.Union):
        return " or ".join(expected(arg) for arg in args if arg is not type(None))
    if origin is Literal:
        return f"one of {', '.join(map(repr, args))}"
    if origin is tuple and args[-1] is not Ellipsis:
        return f"[{', '.join(expected(arg) for arg in args)}]"
    if origin in (tuple, list):
        return "a list"
    if origin is dict or is_section(hint):
        return "a table"
    return _WORDS.get(hint, "something else")


def bounds_of(meta: msgspec.Meta) -> list[str]:
    """The limits of a value in words: "0 to 9"."""
    low, high = _limit(meta.ge), _limit(meta.le)
    if meta.description is not None:
        return [meta.description]
    if meta.pattern is not None:
        return ["digits"] if meta.pattern.startswith("^[0-9]{") else ["of letters, digits, '_', '.' and '-'"]
    if (most := meta.max_length) is not None:
        return [f"of {meta.min_length} to {most:,}" if meta.min_length else f"of up to {most:,}"]
    if meta.min_length is not None:
        return ["not empty" if meta.min_length == 1 else f"of at least {meta.min_length}"]
    if low is not None and high is not None:
        return [f"{low} to {high}"]
    if high is not None and meta.gt is not None:
        return [f"more than {_limit(meta.gt)}, up to {high}"]
    limits = (("at least", low), ("more than", _limit(meta.gt)), ("at most", high), ("less than", _limit(meta.lt)))
    return [f"{word} {limit}" for word, limit in limits if limit is not None]


def _limit(bound: float | None) -> str | None:
    return None if bound is None or abs(bound) >= UNBOUNDED else f"{bound:.12g}"


def bare(hint: Any) -> Any:
    """A type without Annotated and None around it."""
    while True:
        origin = typing.get_origin(hint)
        if origin is Annotated:
            hint = typing.get_args(hint)[0]
        elif origin in (types.UnionType, typing.Union):
            hint = next(arg for arg in typing.get_args(hint) if arg is not type(None))
        else:
            return hint


def is_section(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, msgspec.Struct)


def section_in(hint: Any) -> Any:
    """The section that a key holds, or holds several of; None if it holds values."""
    hint = bare(hint)
    if typing.get_origin(hint) is tuple:
        hint = bare(typing.get_args(hint)[0])
    elif typing.get_origin(hint) is dict:
        hint = bare(typing.get_args(hint)[1])
    return hint if is_section(hint) else None


def is_several(hint: Any) -> bool:
    """Returns True if a key holds several sections."""
    return typing.get_origin(bare(hint)) is tuple and section_in(hint) is not None


# --- errors -------------------------------------------------------------------------------------------------------

_LONGEST_LIST = 200
"""Characters of a list of allowed words; if a similar word is suggested, a longer list is left out."""
_SECONDS = {"s": 1, "sec": 1, "ms": 0.001, "m": 60, "min": 60, "h": 3600}
_UNITS: tuple[tuple[str, dict[str, float]], ...] = (
    ("_m_per_s", {"m/s": 1, "km/h": 1 / 3.6, "kmh": 1 / 3.6}),
    ("_m", {"m": 1, "km": 1000}),
    ("_s", _SECONDS),
    ("seconds", _SECONDS),
    ("", {}),
)
"""Suffix of a key -> units that a user may write after its number, in its own unit."""
_REMOVED = "it was removed after version 0.2:"
_MEANT = {
    r"vehicles\.(count|number|vehicles)": "how many vehicles there are is `vehicles` of [[groups]]",
    r"map\.plot_regions": "it is shard_regions now",
    r"targets\.body_radius_m": "it is obstacle_radius_m now",
    r"monitor\.grpc_port": f"{_REMOVED} native viewers use web_port; leave it out",
    r"cost\.(cross_slope_factor|critical_slope_percent)": f"{_REMOVED} no cost depends on it now; leave it out",
    r"cost\.rough_per_m": f"{_REMOVED} roughness costs nothing; leave it out, or write a cost layer",
    r"cost\.slope_rule = '(herzog\w*|minetti)'": f"{_REMOVED} give its curve as 'table', or use another rule",
    r"terrain\.elevation_encoding = 'terr(ain-rgb|arium)'": f"{_REMOVED} convert tiles to heights; leave it out",
}
"""End of a key, or of a key and its value, as a pattern -> what to write instead."""


def complaint(check: Callable[..., object], *of: object) -> Iterator[str]:
    """The sentence with which a check refuses what it is given, if it does."""
    try:
        check(*of)
    except ConfigError as error:
        yield str(error)


def _meant(found: str) -> str:
    """Returns the advice on a key, or on a key and its value, after "; "; empty if there is none."""
    path = re.sub(r"\[\d+\]", "", found)
    return next((f"; {advice}" for end, advice in _MEANT.items() if re.search(rf"(^|\.)({end})\Z", path)), "")


def explain(reason: str, raw: dict[str, Any], root: type, whole: str = "scenario") -> str:
    """One sentence from msgspec's error message.

    reason  the message: "Expected `int`, got `str` - at `$.targets[0].count`"
    raw     the content of the file
    root    the type that it was to become
    whole   what the file is called
    """
    reason, path = located(reason)
    hint: Any = root
    value: Any = raw
    name = ""
    for step in path:
        if isinstance(step, str):
            name = f"{name}.{step}" if name else step
            hint = _field_type(hint, step)
            value = value.get(step) if isinstance(value, dict) else None
        elif isinstance(value, dict):  # msgspec tells no key of a table that the user names
            hint = _item_type(hint)
            key = next((key for key, each in value.items() if _is_refused(each, hint)), "...")
            name, value = f"{name}.{key}", value.get(key)
        else:
            name += "[...]" if step < 0 else f"[{step}]"
            hint = _item_type(hint)
            value = value[step] if isinstance(value, list) and 0 <= step < len(value) else None
    if unknown := re.fullmatch(r"Object contains unknown field `(.*)`", reason, re.DOTALL):
        return _unknown(unknown[1], name, bare(hint), root)
    if missing := re.fullmatch(r"Object missing required field `(.*)`", reason):
        section = bare(hint)
        wanted = expected(_field_type(section, missing[1])) if hasattr(section, "__struct_fields__") else "a value"
        return f"{name or whole}: missing required field `{missing[1]}`, {wanted}"
    return _wrong(name or whole, value, hint)


def converted(
    given: Any, root: type[T], source: str, whole: str = "scenario", fault: type[SwarmError] = ConfigError
) -> T:
    """The content of a file, or settings from Python, as the type that they are to become. Raises `fault` in one
    sentence.

    source  begins that sentence
    whole   what the file is called
    """
    raw: Any = None
    try:
        raw = plain(given)
        return msgspec.convert(raw, root)
    except msgspec.ValidationError as error:
        raise fault(f"{source}: {explain(str(error), raw, root, whole)}") from error
    except (TypeError, OverflowError, RecursionError) as error:
        raise fault(f"{source}: a value of it is none that a file may have: {error}") from error


_DATES = (datetime.datetime, datetime.date, datetime.time, bytes)
"""Types that are no text, though JSON has texts for them."""


def plain(given: Any) -> Any:
    """A value of Python as a file has it: numbers of NumPy's are numbers, paths are texts."""
    return msgspec.to_builtins(given, builtin_types=_DATES, enc_hook=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    # No field is a list of lists of texts: a value that has no form in a file is refused where it stands.
    found: Any = value.tolist() if hasattr(value, "tolist") else [[type(value).__name__]]
    return float(found) if type(found) is type(value) else found  # of more bits than Python's


def check_keywords(given: Iterable[str], allowed: Sequence[str], what: str) -> None:
    """Raises ConfigError, with the nearest one, on a keyword that is not allowed; `what` names what is called."""
    for key in given:
        if key not in allowed:
            near = nearest(key, allowed)
            raise ConfigError(f"{what}: unknown key {key}{near or allowed_here(allowed)}")


def _is_refused(value: Any, hint: Any) -> bool:
    try:
        msgspec.convert(value, hint)
    except msgspec.ValidationError:
        return True
    return False


def _refused_key(values: dict[str, Any], hint: Any) -> str:
    """The key of a table that the user names which is not of its type, and what it may be."""
    key = next((key for key in values if _is_refused(key, hint)), "")
    if typing.get_origin(bare(hint)) is Literal:
        return f"{key!r}{choice(key, list(map(str, typing.get_args(bare(hint)))))}"
    return f"{key!r}, expected {expected(hint)}"


def located(reason: str) -> tuple[str, list[str | int]]:
    """Splits msgspec's message into text and location: keys and indices from the root on; -1 is an index that it
    does not state."""
    found = re.fullmatch(r"(.*) - at (?:`key` in )?`(.*)`", reason, re.DOTALL)
    if found is None:
        return reason, []
    steps = re.findall(r"\.([A-Za-z_]\w*)|\[(\d+|\.\.\.)\]", found[2])
    return found[1], [key or (-1 if index == "..." else int(index)) for key, index in steps]


def nearest(word: str, allowed: Sequence[str]) -> str:
    """Returns "; did you mean 'x'?" with the most similar of the allowed words; empty if none is similar."""
    close = difflib.get_close_matches(word, allowed, n=1)
    if not close and len(word) >= 3:
        close = [each for each in allowed if each.startswith(word)][:1]
    return f"; did you mean {close[0]!r}?" if close else ""


def doubled(names: Iterable[str], what: str) -> Iterator[str]:
    """A sentence if two settings have one name, such as "targets: two targets are called 'x'; rename one"."""
    for name, times in Counter(names).items():
        if times > 1:
            yield f"{what}: two {what} are called {name!r}; rename one"
            return


def choice(word: str, allowed: Sequence[str], lead: str = " allowed: ") -> str:
    """Returns the sentence about an unknown word: the nearest of the allowed words, and all of them if they are
    few."""
    near, every = nearest(word, allowed), ", ".join(map(repr, allowed))
    if near and len(every) > _LONGEST_LIST:
        return near
    if len(every) > _LONGEST_LIST:
        every = f"{every[: every.rfind(',', 0, _LONGEST_LIST)]}, ..."
    return near + _listed(near, lead.strip(), every)


def _listed(near: str, lead: str, every: str) -> str:
    """Returns a list as the end of a sentence: as one of its own after a guess, which ends with a question mark."""
    return f" {lead.capitalize()} {every}" if near else f"; {lead} {every}"


# --- a key that is not known -----------------------------------------------------------------------------------


def _unknown(key: str, name: str, section: Any, root: type) -> str:
    allowed = list(getattr(section, "__struct_encode_fields__", ()))
    if not key.isprintable():  # it might steer the terminal
        key = repr(key)
    where = f"{name}.{key}" if name else key
    if len(key) > 60:
        return f"unknown key {name + '.' if name else ''}{key[:57]}...{allowed_here(allowed)}"
    if advice := _meant(where):
        return f"unknown key {where}{advice}"
    near = nearest(key, allowed)
    elsewhere = [place for place, other in _places(root) if other is not section and key in hints_of(other)]
    if elsewhere and not difflib.get_close_matches(key, allowed, n=1, cutoff=0.75):
        return f"unknown key {where}; {key} belongs {' or '.join(elsewhere[:3])}"
    every = allowed_here(allowed, near)
    return f"unknown key {where}{near}" + (every if not near or len(every) <= _LONGEST_LIST else "")


def allowed_here(allowed: Sequence[str], near: str = "") -> str:
    """Returns the end of a sentence about an unknown key, after the nearest of the allowed ones."""
    return _listed(near, "allowed here:", ", ".join(allowed))


def _places(root: type) -> Iterator[tuple[str, Any]]:
    """Every section, with how a sentence says where it stands."""
    found = [("", root)]
    for path, section in found:
        yield (f"in {path}" if path else "at the top of the file, before the first [section]"), section
        for key, hint in hints_of(section).items():
            inner = section_in(hint)
            if inner is not None and all(inner is not known for _, known in found):
                joined = f"{path.strip('[]')}.{key}" if path else key
                found.append((f"[[{joined}]]" if is_several(hint) else f"[{joined}]", inner))


# --- a value that is not allowed ------------------------------------------------------------------------------


def _wrong(name: str, value: Any, hint: Any) -> str:
    kind, key = bare(hint), name.rpartition(".")[2].partition("[")[0]
    table = re.sub(r"\[[\d.]+\]", "", name)
    if is_several(hint) and isinstance(value, dict):
        return f"{name}: found [{table}], expected [[{table}]] in two pairs of brackets: there may be several"
    if is_section(kind) and isinstance(value, list):
        return f"{name}: found several tables [[{table}]], expected one: [{table}]"
    if is_section(kind):
        return f"{name}: found {quoted(value)}, expected a table: [{table}] with its keys below"
    if typing.get_origin(kind) is tuple and isinstance(value, str | int | float):
        item = f'"{value}"' if isinstance(value, str) else str(value)
        shape = f"{key} = [{item}]" if typing.get_args(kind)[-1] is Ellipsis else expected(hint)
        return f"{name}: found {quoted(value)}, expected a list: {shape}"
    if typing.get_origin(kind) is Literal:
        allowed = list(map(str, typing.get_args(kind)))
        return f"{name}: found {quoted(value)}{_meant(f'{name} = {value!r}') or choice(str(value), allowed)}"
    if typing.get_origin(kind) is dict and isinstance(value, dict):
        return f"{name}: found the key {_refused_key(value, typing.get_args(kind)[0])}"
    found = "" if isinstance(value, dict | list) and value else f" found {quoted(value)},"
    return f"{name}:{found} expected {expected(hint)}{_finite(value)}{_meant_number(key, value, kind)}"


def _finite(value: Any) -> str:
    """Returns the bound of numbers which their type has beyond those that are said; no user meets it by chance."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return ", and not as large as that" if is_number and abs(value) >= UNBOUNDED else ""


def _meant_number(key: str, value: Any, kind: Any) -> str:
    """Returns the number that a text holds, as a suggestion."""
    if not isinstance(value, str) or len(value) > _LONGEST_LIST or kind not in (int, float):
        return ""
    match = re.fullmatch(r"\s*([+-]?(?:\d+[.,]?\d*|[.,]\d+))\s*(\S.*?)?\s*", value)
    if match is None:
        return ""
    number, unit = float(match[1].replace(",", ".")), match[2]
    if unit is None:
        return f"; leave out the quotes: {key} = {number:g}"
    factor = next(units for ending, units in _UNITS if key.endswith(ending)).get(unit.lower())
    return "; leave out the unit" + ("" if factor is None else f": {key} = {number * factor:.6g}")


def _field_type(section: Any, key: str) -> Any:
    section = bare(section)
    if typing.get_origin(section) is dict:
        return typing.get_args(section)[1]
    return hints_of(section).get(key) if is_section(section) else None


def _item_type(hint: Any) -> Any:
    args = typing.get_args(bare(hint))
    return (args[-1] if typing.get_origin(bare(hint)) is dict else args[0]) if args else None
