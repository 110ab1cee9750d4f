"""Environments as `pip install` makes them, without a network: packages are linked from the running environment."""

import marshal
import sys
import tomllib
import venv
import warnings
from collections.abc import Iterable
from contextlib import suppress
from functools import cache
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]
_SCRIPT = "#!{}\nimport sys\nfrom launch_scripts.entry import main\nsys.exit(main())\n"


@cache
def packages(*extras: str) -> dict[str, Distribution]:
    """Distributions which the base and these extras install, by name."""
    found: dict[str, Distribution] = {}
    waiting = [*PROJECT["dependencies"], *(line for each in extras for line in EXTRAS[each])]
    while waiting:
        wanted = Requirement(waiting.pop())
        name = canonicalize_name(wanted.name)
        if name == PROJECT["name"]:
            waiting += [line for each in wanted.extras for line in EXTRAS[each]]
        elif name not in found and (wanted.marker is None or wanted.marker.evaluate({"extra": ""})):
            found[name] = distribution(name)
            waiting += found[name].requires or ()
    return found


def files_of(found: dict[str, Distribution]) -> list[Path]:
    return [Path(str(file.locate())) for each in found.values() for file in each.files or ()]


def megabytes(paths: Iterable[Path]) -> float:
    """Size of files with the byte code that pip writes beside each module."""
    files = [path for path in paths if path.suffix != ".pyc" and path.is_file()]
    modules = [path for path in files if path.suffix == ".py" and "bin" not in path.parts]
    return (sum(path.stat().st_size for path in files) + sum(map(_code_bytes, modules))) / 2**20


@cache
def _code_bytes(module: Path) -> int:
    """Size of a module's byte code; 0 of a file that is for another Python."""
    with warnings.catch_warnings(action="ignore"), suppress(SyntaxError, ValueError):
        return len(marshal.dumps(compile(module.read_bytes(), str(module), "exec", dont_inherit=True)))
    return 0


def environment(folder: Path, *extras: str) -> Path:
    """Makes an environment with these extras, and with the command. Returns the folder of its packages."""
    venv.create(folder, symlinks=True)
    site = folder / "lib" / f"python3.{sys.version_info.minor}" / "site-packages"
    for each in packages(*extras).values():
        for top in {file.parts[0] for file in each.files or ()} - {"..", "__pycache__"}:
            if not (site / top).exists():
                (site / top).symlink_to(str(each.locate_file(top)))
    script = folder / "bin" / "swarm"
    script.write_text(_SCRIPT.format(folder / "bin" / "python"), encoding="utf-8")
    script.chmod(0o755)
    return site
