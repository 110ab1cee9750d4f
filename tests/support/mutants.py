"""Mutation tests of the cores: does a test fail when a line is broken? `./launch_scripts/test --mutants`.

Each mutant is one change of one place by an operator of cosmic-ray: a comparison, a number, a branch. It is made in
a copy of the tree (`.mutants/`, where compiled kernels stay from run to run), and the tests that import its module
run against it, without network, until the first one fails. That test is then run once without the mutant, and must
pass: a broken suite kills no mutant. A survivor is either a rule that no test holds or a change without effect;
both are listed with file, line and difference, and the exit code is 1.

cosmic-ray's own runner wants a database and one command for all modules. Its operators, called as a library, let
each mutant meet only the tests that can see it, which is what makes a sample of 200 affordable.
"""

import argparse
import ast
import compileall
import difflib
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

ROOT = Path(__file__).parents[2]
COPY = ROOT / ".mutants"
CORES = ("swarm", "shared_map/replication", "vehicle_agent/traffic", "planner_service")
NOT_MUTATED = ("planner_service/kernels", "planner_service/kernel_build.py")
"""Compiled code: each mutant would take a minute of compilation, and laws hold kernels against slow twins."""
OPERATORS = (
    *(f"core/ReplaceComparisonOperator_{pair}" for pair in (
        "Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is")),
    *(f"core/ReplaceBinaryOperator_{pair}" for pair in (
        "Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul")),
    "core/AddNot", "core/ReplaceUnaryOperator_Delete_Not", "core/ReplaceTrueWithFalse", "core/ReplaceFalseWithTrue",
    "core/ReplaceAndWithOr", "core/ReplaceOrWithAnd", "core/NumberReplacer", "core/ReplaceBreakWithContinue",
    "core/ReplaceContinueWithBreak", "core/ZeroIterationForLoop",
)  # fmt: skip
KILLER = re.compile(r"^(?:FAILED|ERROR) ([^\[\s]+)", re.MULTILINE)
"""The test that failed, in the last lines of pytest, without its parameters."""


class Mutant(NamedTuple):
    """One change: the `occurrence`th place of a file where an operator applies."""

    file: str
    line: int
    operator: str
    occurrence: int


def mutants_of(path: Path, lines: set[int] | None) -> Iterator[Mutant]:
    """All mutants of a file; only on these lines if any are given."""
    tree = get_ast_from_path(path)
    nodes = list(ast_nodes(tree))
    for name in OPERATORS:
        operator = get_operator(name)()
        places = [(start, node) for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, ((line, _), node) in enumerate(places):
            if node.type == "number" and not node.value.isdecimal():
                continue  # a duration of a wait, or a tolerance: one more or less breaks no rule
            if lines is None or line in lines:
                yield Mutant(path.relative_to(ROOT).as_posix(), line, name, occurrence)


def changed_lines(since: str, path: Path) -> set[int]:
    """Lines of a file that are not as they were at a commit."""
    diff = subprocess.run(
        ["git", "diff", "-U0", since, "--", path], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    found: set[int] = set()
    for start, count in re.findall(r"^@@ -\S+ \+(\d+)(?:,(\d+))? @@", diff, re.MULTILINE):
        found.update(range(int(start), int(start) + int(count or 1)))
    return found


def core_files(named: Iterable[str]) -> list[Path]:
    """The files that are named, or those of all cores."""
    some = [ROOT / name for name in named] or [path for core in CORES for path in (ROOT / core).rglob("*.py")]
    return sorted(path for path in some if not path.relative_to(ROOT).as_posix().startswith(NOT_MUTATED))


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{each.name}" for each in node.names)}
        elif isinstance(node, ast.Import):
            found |= {each.name for each in node.names}
    return found


class Suite:
    """Test files that see a module: those that import it, themselves or by a module of `tests/support`. If none
    does, those which see the modules of its core that import it.
    """

    def __init__(self) -> None:
        folder = ROOT / "tests"
        support = {f"support.{path.stem}": _imports(path) for path in (folder / "support").glob("*.py")}
        files = [*sorted((folder / "unit").rglob("test_*.py")), *sorted((folder / "laws").glob("test_*.py"))]
        self._direct = {path.relative_to(ROOT).as_posix(): _imports(path) for path in files}
        self._by_support = {
            path: {name for each in own & support.keys() for name in support[each]}
            for path, own in self._direct.items()
        }
        self._core = {path.relative_to(ROOT).as_posix(): _imports(path) for path in core_files(())}
        self._passes: dict[tuple[str, ...], bool] = {}

    def of(self, file: str, steps: int = 2) -> list[str]:
        """Test files for a file of the product, those that name it first; none if no test imports it within that
        number of steps."""
        module = file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
        direct = [path for path, names in self._direct.items() if module in names]
        by_support = [path for path, names in self._by_support.items() if module in names]
        found = list(dict.fromkeys([*direct, *by_support]))
        if not found and steps:
            users = [each for each, names in self._core.items() if module in names]
            return list(dict.fromkeys(test for user in users for test in self.of(user, steps - 1)))
        return found

    def passes(self, tests: list[str], limit_s: float) -> bool:
        """True if these tests pass in time while nothing is broken."""
        key = tuple(tests)
        if key not in self._passes:
            self._passes[key] = run_tests(tests, limit_s)[0] == 0
        return self._passes[key]


def run_tests(tests: list[str], limit_s: float) -> tuple[int | None, str]:
    """Exit code of pytest in the copy, None if it took too long, and what it said.

    No bytecode is written: that of a mutant would be taken for the next one of the same length and second.
    """
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=no", "--network", "none", "-p", "no:cacheprovider"]
    environment = {**os.environ, "PYTHONPATH": f"{COPY}:{COPY / 'tests'}", "PYTHONDONTWRITEBYTECODE": "1"}
    with subprocess.Popen(
        [*command, *tests],
        cwd=COPY,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            said, _ = process.communicate(timeout=limit_s)
            return process.returncode, said
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            if isinstance(error, subprocess.TimeoutExpired):
                return None, ""
            raise


def refresh_copy() -> None:
    """Makes `.mutants/` equal to what git knows of the tree, and leaves the compiled kernels in it."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    for path in COPY.rglob("*.py"):
        if path.relative_to(COPY).as_posix() not in listed:
            path.unlink()
    for name in listed:
        target = COPY / name
        if (ROOT / name).is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.is_file() or target.read_bytes() != (ROOT / name).read_bytes():
                shutil.copy2(ROOT / name, target)
    compileall.compile_dir(COPY, quiet=2)


def tried(mutant: Mutant, suite: Suite, limit_s: float) -> tuple[str, list[str], list[str]]:
    """Outcome of a mutant, the test that killed it, and its difference. It is killed, has survived, or is untested
    where no test sees its module in time."""
    path, tests = COPY / mutant.file, suite.of(mutant.file)
    source = path.read_text(encoding="utf-8")
    mutated = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
    assert mutated is not None, mutant
    diff = list(difflib.unified_diff(source.splitlines(), mutated.splitlines(), lineterm="", n=0))[3:]
    code, said = 5, ""
    if tests:
        try:
            path.write_text(mutated, encoding="utf-8")
            code, said = run_tests(tests, limit_s)
        finally:
            path.write_text(source, encoding="utf-8")
    killer = KILLER.findall(said)[:1]
    if code == 0:
        outcome = "survived"
    elif code == 5:  # pytest's word for no test
        outcome = "untested"
    else:  # one that hangs is killed if all tests pass in that time without it
        outcome = "killed" if suite.passes(killer or tests, limit_s) else "untested"
    return outcome, killer, diff


def main() -> int:
    parser = argparse.ArgumentParser(prog="./launch_scripts/test --mutants", description=__doc__)
    parser.add_argument("files", nargs="*", help="files of the product; all cores if none is named")
    parser.add_argument(
        "--since", metavar="REV", help="only lines that differ from this commit; HEAD~1 if no file is named"
    )
    parser.add_argument("--all", action="store_true", help="all lines, whatever has changed")
    parser.add_argument("--most", type=int, default=50, help="a sample of so many mutants at most (50)")
    parser.add_argument("--seed", type=int, default=1, help="of the sample (1)")
    parser.add_argument("--seconds", type=float, default=300.0, help="for the tests of each mutant at most (300)")
    chosen = parser.parse_args()
    since = chosen.since or (None if chosen.files or chosen.all else "HEAD~1")
    found: list[Mutant] = []
    for path in core_files(chosen.files):
        found += mutants_of(path, changed_lines(since, path) if since else None)
    sample = random.Random(chosen.seed).sample(found, min(chosen.most, len(found)))
    print(f"{len(sample)} of {len(found)} mutants", file=sys.stderr)
    refresh_copy()
    suite, counts = Suite(), dict.fromkeys(("killed", "survived", "untested"), 0)
    for number, mutant in enumerate(sample, 1):  # stopped early, it was a smaller sample
        outcome, killer, diff = tried(mutant, suite, chosen.seconds)
        counts[outcome] += 1
        print(f"{number}/{len(sample)} {outcome:8} {mutant.file}:{mutant.line}", *killer, file=sys.stderr)
        if outcome != "killed":
            print("\n".join(f"    {line}" for line in diff), file=sys.stderr)
    print(", ".join(f"{many} {name}" for name, many in counts.items()))
    return 1 if counts["survived"] or counts["untested"] else 0


if __name__ == "__main__":
    sys.exit(main())
