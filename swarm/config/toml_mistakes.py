"""What is wrong with a text that is no TOML: the line, the column, and what was probably meant."""

from __future__ import annotations

import re

_PLACED = re.compile(r"(.*) \(at (?:line (\d+), column (\d+)|end of document)\)", re.DOTALL)


def toml_mistake(reason: str, text: str) -> str:
    """One sentence from the parser's message, such as "Invalid value (at line 2, column 8)"."""
    placed = _PLACED.fullmatch(reason)
    if placed is None and reason.startswith("Exceeds the limit"):
        return "it holds a number of thousands of digits"
    if placed is None:
        return reason[:1].lower() + reason[1:]
    what = placed[1]
    lines = text.rstrip().split("\n")
    if placed[2] is None:  # it ends too soon, so what is wrong began before
        number, line, rest = len(lines), lines[-1], ""
    else:
        number = int(placed[2])
        line = text.split("\n")[number - 1]
        rest = line[int(placed[3]) - 1 :].strip()
    where = f"line {number}" if placed[3] is None else f"line {number}, column {placed[3]}"
    return f"{where}: {_meant(what, line.strip(), rest) or f'{_lower(what)} in {_cut(line)!r}'}"


def _meant(what: str, line: str, rest: str) -> str:
    """What is said of a line; `rest` begins where the parser stopped. Empty if that is not known."""
    key = line.partition("=")[0].strip()
    value = line.partition("=")[2].strip()
    if what.startswith(("Illegal character '\\n'", "Unterminated string")):
        return f"a quote is missing at the end of {_cut(line)!r}"
    if what == "Cannot overwrite a value":
        return (
            f"{_cut(key)!r} is set twice"
            if "=" in line
            else f"{_cut(line)} stands twice: put all of its keys below one"
        )
    if what.startswith("Cannot declare"):
        return f"{_cut(line)} stands twice: put all of its keys below one"
    if what.startswith("Invalid value"):
        word = re.match(r"[\w.+-]*", rest)
        if rest[:4].lower() in ("true", "fals"):
            return f"write {key} = {value.lower()}, in small letters"
        if word is not None and word[0][:1].isalpha():
            return f"text goes in quotes: {key} = {_quoted(value)}"
        return f"{key} has no value that TOML knows: {_cut(rest)!r}" if rest else f"{key} has no value"
    if what.startswith("Expected newline or end of document") and "=" in line:
        if re.match(r",\s*\d", rest):
            return f"write {_cut(line.replace(',', '.'))}, with a point, or a list in brackets"
        if re.match(r"[A-Za-z%°]", rest):
            return f"nothing may follow the value: the unit is in the key's name, so leave {_cut(rest)!r} out"
        return f"nothing may follow the value, found {_cut(rest)!r}"
    if what.startswith("Unclosed"):
        return "a bracket that is opened is not closed before the end of the file"
    if what.startswith("Expected '=' after a key"):
        return f"expected KEY = VALUE or [SECTION], found {_cut(line)!r}"
    return ""


def _quoted(value: str) -> str:
    return f'"{_cut(value.split("#")[0].strip())}"'


def _cut(text: str) -> str:
    text = text.strip()
    return text if len(text) <= 60 else f"{text[:57]}..."


def _lower(text: str) -> str:
    return text[:1].lower() + text[1:]
