"""Checks the English of the product: `python .ci/words.py`, exit code 1 with a sentence per fault.

- A docstring begins with a noun phrase or a verb in the third person: no word of `FIRST` begins one.
- No word of `BANNED` occurs in a text of the product, such as a docstring, a help or an error, nor in a comment, a
  page or the name of a test: each has a plain term.

`budget.toml` holds in `[words]` how many faults each tree may still have. A row only falls.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path

from house import ROOT, docstrings

FIRST = re.compile(
    r"(What|Who|Whose|Whom|Whoever|Where|When|Why|Which|Whether|How|Of|So|As|That|Nobody|Somebody|Lets?)\b"
)
"""How many, How long and the like begin a question, too."""
BANNED = re.compile(
    r"\b(nobody|somebody|whoever|whomever|so many|anew|mends?|mended|dear|dearer|dearest|hand(s|ed)? out)\b", re.I
)
_CODE = re.compile(r"```.*?```|`[^`]*`|^ *[a-z_, ]+ {2,}", re.S | re.M)
"""Code, and the names that begin the rows of a docstring."""


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Yields the line and the text of each comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def texts_of(source: str) -> Iterator[tuple[int, str]]:
    """Yields the line and the words of each string, parts of formatted ones among them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def names_of_tests(source: str) -> Iterator[tuple[int, str]]:
    """Yields the line and the words of each test's name."""
    for found in re.finditer(r"^ *(?:async )?def test_(\w+)", source, re.M):
        yield source.count("\n", 0, found.start()) + 1, found[1].replace("_", " ")


def faults_of(path: Path) -> Iterator[str]:
    """Yields a sentence per fault of a Python file or a page."""
    text = path.read_text(encoding="utf-8")
    where = path.relative_to(ROOT)
    if path.suffix == ".md":
        texts = [(number, line) for number, line in enumerate(_CODE.sub("`", text).splitlines(), 1)]
    else:
        first = [(each.lineno, str(each.value)) for each in docstrings(path)]
        for line, each in first:
            if found := FIRST.match(each.strip()):
                yield f'{where}:{line}: a docstring begins with "{found[0]}": begin with a noun phrase or a verb'
        own = first if where.parts[0] == "tests" else texts_of(text)
        texts = [*own, *comments(text), *names_of_tests(text)]
    for line, each in texts:
        for found in BANNED.finditer(_CODE.sub("`", each)):
            yield f'{where}:{line}: "{found[0]}": there is a plain term for it'


def main() -> int:
    """Prints the faults of each tree with more than its row allows; returns the exit code."""
    rows = tomllib.loads((ROOT / "budget.toml").read_text(encoding="utf-8"))["words"]
    over = False
    for tree, most in rows.items():
        root = ROOT / tree
        paths = sorted(root.rglob("*")) if root.is_dir() else [root]
        paths = [path for path in paths if path.suffix in (".py", ".md")]
        faults = [each for path in paths for each in faults_of(path)]
        if "--show" in sys.argv:
            print(f"{tree:20}{len(faults):6}")
        if len(faults) > most:
            over = True
            print("\n".join(faults), file=sys.stderr)
            print(f"{tree}: {len(faults)} faults, of which budget.toml allows {most}", file=sys.stderr)
    return over


if __name__ == "__main__":
    sys.exit(main())
