"""Readers of the user's files, which are refused by size before they are read, in one sentence.

`FileKind` is the table of what may be read and how much of it. A new kind of file is a row.
"""

from __future__ import annotations

import datetime
import re
import stat
import tomllib
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

from swarm.errors import ConfigError, StoreError, SwarmError, TerrainError
from swarm.grid import MAX_CELLS

MAX_LINE_BYTES = 16 << 20
"""Longest line of a text that is read line by line."""
MAX_DEPTH = 16
"""Deepest nesting of brackets and dotted keys in TOML. The parser's time grows with the square of it."""


class FileKind(Enum):
    """Kind of an input file: its name in sentences, the largest size that is read (bytes), the error that refuses
    it."""

    SCENARIO = ("scenario", 1 << 19, ConfigError)
    HOSTS = ("hosts", 1 << 19, ConfigError)
    STUDY = ("study", 1 << 19, ConfigError)
    CERTIFICATE = ("certificate or key", 1 << 16, StoreError)
    REVOKED = ("revoked names", 1 << 20, ConfigError)  # room for some 16,000 of the longest names
    SLOPE_TABLE = ("slope table", 1 << 18, ConfigError)
    LABELS = ("labels", 4 << 20, TerrainError)
    COVER_TABLE = ("cover codes", 4 << 20, TerrainError)
    POINTS = ("terrain", 2 << 30, TerrainError)
    ROS_MAP = ("terrain", 1 << 16, TerrainError)
    TEXT_GRID = ("terrain", 32 * MAX_CELLS, TerrainError)
    ARRAYS = ("terrain", 12 * MAX_CELLS, TerrainError)
    IMAGE = ("image", 8 * MAX_CELLS, TerrainError)
    SYSTEM = ("coordinate system", 1 << 16, TerrainError)
    VIRTUAL_RASTER = ("raster", 4 << 20, TerrainError)
    VECTORS = ("zone", 1 << 30, TerrainError)
    VECTOR_TEXT = ("zone", 256 << 20, TerrainError)
    PREPARED = ("prepared terrain", 1 << 20, TerrainError)
    TRACKS = ("tracks", 256 << 20, StoreError)
    RUN = ("run", 256 << 20, StoreError)
    STORE = ("store", 4 << 30, StoreError)
    PROMISES = ("promises", 256 << 20, StoreError)
    GENERATIONS = ("generations", 1 << 20, StoreError)
    RECORDING = ("recording", 256 << 20, StoreError)

    def __init__(self, what: str, most_bytes: int, error: type[SwarmError]) -> None:
        self.what = what
        self.most_bytes = most_bytes
        self.error = error

    def refusal(self, path: Path, why: str, what: str = "") -> SwarmError:
        """Returns the error of a file that cannot be read.

        why   reason, the end of the sentence
        what  the file and the key that names it, in words; empty: the kind and the path
        """
        return self.error(f"cannot read {what or f'{self.what} {path}'}: {why}")

    def unreadable(self, path: Path, error: OSError) -> SwarmError:
        return self.refusal(path, error.strerror or str(error))


def check_file(path: Path, kind: FileKind, what: str = "") -> int:
    """Bytes of a file. Raises the kind's error, which names `what`, if it is no file, or cannot be looked at."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise kind.refusal(path, why, what) from error
    if not stat.S_ISREG(found.st_mode):
        found_is = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or pipe"
        raise kind.refusal(path, f"it is {found_is}, not a file", what)
    return found.st_size


def check_bytes(path: Path, kind: FileKind, what: str = "") -> int:
    """Bytes of a file. Raises the kind's error as `check_file` does, and if it is larger than is read."""
    count = check_file(path, kind, what)
    if count > kind.most_bytes:
        raise kind.refusal(path, f"it has {size(count)}; at most {size(kind.most_bytes)} are read", what)
    return count


def read_bytes(path: Path, kind: FileKind) -> bytes:
    """The content of a file."""
    check_bytes(path, kind)
    try:
        with path.open("rb") as file:
            data = file.read(kind.most_bytes + 1)
    except OSError as error:
        raise kind.unreadable(path, error) from error
    if len(data) > kind.most_bytes:  # it has grown since
        raise kind.refusal(path, f"it has more than {size(kind.most_bytes)}")
    return data


def read_text(path: Path, kind: FileKind, encoding: str = "utf-8") -> str:
    try:
        return read_bytes(path, kind).decode(encoding)
    except UnicodeDecodeError as error:
        raise kind.error(
            f"{kind.what} {path} is not text in {encoding.upper()}: {error.reason} at byte {error.start}"
        ) from error


def read_lines(path: Path, kind: FileKind, longest: int = MAX_LINE_BYTES) -> Iterator[str]:
    """The lines of a text in UTF-8, without their ends, one after the other: only one is held."""
    check_bytes(path, kind)
    try:
        with path.open("rb") as file:
            number = 0
            while line := file.readline(longest + 1):
                number += 1
                if len(line) > longest:
                    raise kind.refusal(path, f"line {number} is longer than {size(longest)}")
                yield line.decode("utf-8-sig" if number == 1 else "utf-8").rstrip("\r\n")
    except OSError as error:
        raise kind.unreadable(path, error) from error
    except UnicodeDecodeError as error:
        raise kind.error(f"{kind.what} {path} is not text: line {number} is not UTF-8") from error


def size(count: int) -> str:
    """A number of bytes, as people read it."""
    for power, unit in ((9, "GB"), (6, "MB")):
        if count >= 10 ** (power - 1):
            return f"{count / 10**power:.1f} {unit}"
    return f"{count} bytes"


# --- TOML ---------------------------------------------------------------------------------------------------

_NOT_STRUCTURE = re.compile(
    r"""
    "{3} (?: \\. | [^\\] )*? (?: "{3} | \Z )
    | '{3} .*? (?: '{3} | \Z )
    | " (?: \\. | [^"\\\n] )* "?
    | ' [^'\n]* '?
    | [#] [^\n]*
    """,
    re.DOTALL | re.VERBOSE,
)
"""Strings and comments. Every alternative matches once begun, so a scan takes time in proportion to the text."""
_WORD = re.compile(r"[^\s.=,\[\]{}]+")
_DOTTED = re.compile(r"(?:k?\.){" + str(MAX_DEPTH) + "}")


def parse_toml(text: str, source: str, error: type[SwarmError]) -> dict[str, Any]:
    """The values of a TOML text. Raises `error` with one sentence that begins with `source`."""
    depth = 0
    bare = _NOT_STRUCTURE.sub("s", text)
    for bracket in re.finditer(r"[\[\]{}]", bare):
        depth = depth + 1 if bracket[0] in "[{" else depth - 1
        if depth > MAX_DEPTH:
            raise error(f"{source}: not TOML that is read here: brackets are nested deeper than {MAX_DEPTH}")
    words = _WORD.sub("k", bare).replace(" ", "").replace("\t", "")
    if _DOTTED.search(words):
        raise error(f"{source}: not TOML that is read here: a key has more than {MAX_DEPTH} parts")
    try:
        return tomllib.loads(text.removeprefix("\ufeff"))
    except ValueError as fault:  # a TOMLDecodeError, or a number of more digits than Python reads
        raise error(f"{source}: not TOML: {_toml_fault(str(fault), text)}") from fault


_TOML_FAULTS = {
    "Invalid value": "no value of TOML: put text in quotes, and write true and false in small letters",
    "Illegal character '\\n'": "a quote is missing at the end",
    "Unterminated string": "a quote is missing at the end",
    "Cannot overwrite a value": "a key is set twice, or a value would be a table",
    "Cannot declare": "a section occurs twice: put all of its keys below one",
    "Expected newline or end of document": "nothing may follow a value; units are in the keys' names",
    "Unclosed": "a bracket that is opened is not closed before the end of the file",
    "Expected '=' after a key": "expected KEY = VALUE or [SECTION]",
    "Exceeds the limit": "it holds a number of thousands of digits",
}
"""First words of the parser's message -> explanation for readers who do not know TOML."""
_TOML_PLACE = re.compile(r" \(at (?:line (\d+)(, column \d+)|end of document)\)\Z")


def _toml_fault(reason: str, text: str) -> str:
    """A sentence from the parser's message, such as "Invalid value (at line 2, column 8)", with the line itself."""
    place = _TOML_PLACE.search(reason)
    what = reason if place is None else reason[: place.start()]
    meant = next((each for begin, each in _TOML_FAULTS.items() if what.startswith(begin)), what)
    if place is None:
        return meant
    lines = text.rstrip().split("\n")
    number = int(place[1]) if place[1] else len(lines)  # the file ends too soon, so the fault began before
    line = lines[min(number, len(lines)) - 1].strip()
    return f"line {number}{place[2] or ''}: {meant}, found {line if len(line) <= 60 else f'{line[:57]}...'!r}"


def quoted(value: object) -> str:
    """A value as a sentence quotes it, however large it is; dates and truth as TOML writes them."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, datetime.date | datetime.time):
        return value.isoformat()
    if isinstance(value, int) and value.bit_length() > 256:
        return f"a whole number of {value.bit_length()} bits"
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
