"""Checks that the house keeps its size and its order: `python .ci/house.py`, exit code 1 with a sentence per fault.

`budget.toml` has a row per folder: lines of code, which are physical lines with a token other than a comment or a
docstring, files, and for documentation words. A row covers what no row of a deeper folder covers. The order:

- each file of the product belongs to a row, and no row is exceeded; the sums of `[product]` hold, too
- no module shorter than 60 lines is imported by one module of its own folder only: it belongs into that one
- a basename occurs once in the product; `service.py`, `main.py` and `__init__.py` are parts of every role
- only those that take part in a swarm subscribe (`SUBSCRIBERS`), and nothing reads `/proc`
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PRODUCT = ("swarm", "shared_map", "planner_service", "vehicle_agent", "launch_scripts")
SHORT = 60
"""All lines of a module which is too short to stand alone."""
OF_EVERY_ROLE = {"__init__.py", "service.py", "main.py"}
SUBSCRIBERS = (
    "swarm/bus", "swarm/client", "swarm/runtime", "swarm/recording", "swarm/right_of_way", "shared_map/replication",
    "shared_map/keeper", "planner_service", "vehicle_agent", "launch_scripts/observe", "launch_scripts/simulation",
)  # fmt: skip
_NOT_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
    tokenize.ENCODING,
}  # fmt: skip
Rows = dict[str, dict[str, int]]


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def docstrings(path: Path) -> Iterator[ast.Constant]:
    """Yields the docstrings of a file, those of constants and fields included."""
    for node in ast.walk(tree_of(path)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            yield node.value


def code_lines(path: Path) -> int:
    """Number of physical lines that hold code."""
    said: set[int] = set()
    for each in docstrings(path):
        said.update(range(each.lineno, (each.end_lineno or each.lineno) + 1))
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type not in _NOT_CODE:
            code.update(range(token.start[0], token.end[0] + 1))
    return len(code - said)


def row_of(path: Path, rows: Rows) -> str | None:
    """The deepest folder above a file that has a row; None if there is none."""
    folders = path.relative_to(ROOT).parents
    return next((name for each in folders if (name := each.as_posix()) in rows), None)


def counted(files: list[Path], rows: Rows) -> tuple[Rows, list[str]]:
    """Lines and files of each row, and the files that no row covers."""
    found: Rows = {name: {"lines": 0, "files": 0} for name in rows}
    homeless = []
    for path in files:
        if name := row_of(path, rows):
            found[name]["lines"] += code_lines(path)
            found[name]["files"] += 1
        else:
            homeless.append(f"{path.relative_to(ROOT)}: no row of budget.toml covers it")
    return found, homeless


def over(found: Rows, budget: Rows) -> Iterator[str]:
    for name, row in found.items():
        for what, many in row.items():
            if what in budget[name] and many > budget[name][what]:
                yield f"{name}: {many:,} {what}, of which budget.toml allows {budget[name][what]:,}"


def words(rows: Rows) -> Rows:
    """Words of Markdown below each folder or in each file, as `wc -w` counts them."""
    found = {}
    for name in rows:
        path = ROOT / name
        pages = [path] if path.is_file() else sorted(path.rglob("*.md"))
        mine = [page for page in pages if page == path or row_of(page, rows) == name]
        found[name] = {"words": sum(len(page.read_text(encoding="utf-8").split()) for page in mine)}
    return found


def importers(files: list[Path]) -> dict[Path, set[Path]]:
    """Which files import each file."""
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files
    }
    found: dict[Path, set[Path]] = defaultdict(set)
    for path in files:
        for node in ast.walk(tree_of(path)):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [each.name for each in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module, *(f"{node.module}.{each.name}" for each in node.names)]
            for name in names:
                if name in modules and modules[name] != path:
                    found[modules[name]].add(path)
    return found


def order(files: list[Path]) -> Iterator[str]:
    by_name: dict[str, list[Path]] = defaultdict(list)
    importing = importers(files)
    for path in files:
        where = path.relative_to(ROOT)
        text = path.read_text(encoding="utf-8")
        if path.name not in OF_EVERY_ROLE:
            by_name[path.name].append(where)
            by = importing[path]
            if text.count("\n") < SHORT and len(by) == 1 and (only := next(iter(by))).parent == path.parent:
                yield f"{where}: shorter than {SHORT} lines, and only {only.name} beside it imports it"
        if not where.as_posix().startswith(SUBSCRIBERS) and re.search(r"\.(subscribe|collect)\(", text):
            yield f"{where}: subscribes, which is for {', '.join(SUBSCRIBERS)}"
        if re.search(r"[\"'(]/proc\b(?!/cpuinfo)", text):  # psutil does not say what a processor is called
            yield f"{where}: reads /proc, which psutil does"
    for name, places in sorted(by_name.items()):
        if len(places) > 1:
            yield f"{name} occurs {len(places)} times: {', '.join(map(str, places))}"


def main() -> int:
    budget = tomllib.loads((ROOT / "budget.toml").read_text(encoding="utf-8"))
    files = sorted(path for name in PRODUCT for path in (ROOT / name).rglob("*.py"))
    found, faults = counted(files, budget["rooms"])
    total = {what: sum(row[what] for row in found.values()) for what in ("lines", "files")}
    others = sorted({path for name in budget["beside"] for path in (ROOT / name).rglob("*.py")})
    beside, _ = counted(others, budget["beside"])
    pages = words(budget["docs"])
    faults += over({"product": total}, {"product": budget["product"]})
    for some, rows in ((found, budget["rooms"]), (beside, budget["beside"]), (pages, budget["docs"])):
        faults += over(some, rows)
    faults += order(files)
    if "--show" in sys.argv:
        alone = sum(1 for by in importers(files).values() if len(by) == 1)
        for name, row in {**found, **beside, **pages, "product": total}.items():
            print(f"{name:36}" + "".join(f"{many:8,} {what}" for what, many in row.items()))
        print(f"{alone} modules that one module imports")
    for fault in sorted(set(faults)):
        print(fault, file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
