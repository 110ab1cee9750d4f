"""Writes every generated page of the reference.

python -m docs.generate            writes them
python -m docs.generate --check    exit code 1 if a file is not what the code says

Both refuse a change of the wire that builds before this one could not read.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from docs.generate import cli_page, cover_page, ros2_page, scenario_page, ways_page, wire_lock, wire_page

PAGES: dict[Path, Callable[[], str]] = {
    wire_page.PATH: wire_page.document,
    wire_lock.PATH: wire_lock.document,
    scenario_page.PATH: scenario_page.document,
    scenario_page.SCHEMA_PATH: scenario_page.schema,
    cli_page.PATH: cli_page.document,
    cover_page.PATH: cover_page.document,
    ways_page.PATH: ways_page.document,
    ros2_page.PATH: ros2_page.document,
}


def stale() -> list[Path]:
    """The files that are not what the code says."""
    return [
        path for path, make in PAGES.items() if not path.is_file() or path.read_text(encoding="utf-8") != make()
    ]


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m docs.generate", description="Write the generated pages of the reference."
    )
    parser.add_argument("--check", action="store_true", help="only tell whether the files are current")
    check = parser.parse_args().check
    if faults := wire_lock.faults():
        print("\n".join(faults), file=sys.stderr)
        return 1
    if check:
        for path in stale():
            print(f"{path} is not current: run `python -m docs.generate`", file=sys.stderr)
        return 1 if stale() else 0
    for path, make in PAGES.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(make(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
