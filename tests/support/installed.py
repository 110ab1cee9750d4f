"""Environments as `pip install` makes them, without a network: packages are linked from the running environment."""

from __future__ import annotations

import sys
import tomllib
import venv
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


def megabytes(found: dict[str, Distribution]) -> float:
    paths = [Path(str(file.locate())) for each in found.values() for file in each.files or ()]
    return sum(path.stat().st_size for path in paths if path.suffix != ".pyc" and path.is_file()) / 2**20


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
