"""Built-in terrains of earlier runs, kept in the user's cache folder: making one again gives the same bits, slowly.

A terrain is kept under the digest of all that it is made from: the scenario's part in it, and the code. Its files
are linked into a run's folder where the file system allows, so that they lie on the disk once. Every file is
checked against its digest before it is used again.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import logging
import os
import shutil
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import msgspec

from shared_map.source_digest import source_digest
from swarm.config.load import BUILT_IN_TERRAINS
from swarm.config.scenario import Scenario

log = logging.getLogger(__name__)

MOST_BYTES = 2 << 30
"""Of all kept terrains together; the ones used longest ago go first."""
_SUMS = "sums.json"
_ABANDONED_S = 3600.0


def kept_root() -> Path:
    """Where terrains are kept."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "terrain-swarm" / "terrain"


def kept_key(scenario: Scenario) -> str | None:
    """Digest of all that a terrain and its truth follow from; None where files of the user's have a part in it."""
    terrain, cost = scenario.terrain, scenario.cost
    zones = (*cost.zones, *terrain.hidden.zones)
    files = terrain.photo or terrain.labels or terrain.cover or cost.layers or any(z.mask or z.file for z in zones)
    if terrain.source not in BUILT_IN_TERRAINS or files:
        return None
    here = Path(__file__).parent
    rooms = (here, here.parent / "importers")
    code = source_digest(here.parent, *sorted(each.parent for room in rooms for each in room.rglob("__init__.py")))
    # One of them brings the elevation of "jacksboro".
    libraries = " ".join(map(version, ("scipy", "matplotlib")))
    payload = msgspec.json.encode([code, libraries, scenario.seed, terrain, cost], order="sorted")
    return hashlib.blake2b(payload, digest_size=16).hexdigest()


def fetch_kept(key: str, into: Path) -> bool:
    """Put the files of a kept terrain into a folder. False if there is none; a damaged one is dropped, and said."""
    folder = kept_root() / key
    if not folder.is_dir():
        return False
    try:
        sums = json.loads((folder / _SUMS).read_text(encoding="utf-8"))
        names = [name for name in sums if name == Path(name).name]
        with ThreadPoolExecutor(2) as pool:
            found = dict(zip(names, pool.map(_sum, (folder / name for name in names)), strict=True))
        if not names or found != sums:
            raise ValueError("a file is not as it was written")
        into.mkdir(parents=True, exist_ok=True)
        for name in names:
            _link(folder / name, into / name)
        os.utime(folder)
    except (OSError, ValueError, AttributeError, TypeError) as error:
        log.warning("the kept terrain %s is damaged (%s): making it anew", folder, error)
        shutil.rmtree(folder, ignore_errors=True)
        return False
    return True


def keep(key: str, files: Iterable[Path]) -> None:
    """Keep these files of a terrain. Where that is not possible nothing is kept, and nothing is wrong."""
    files = list(files)
    root = kept_root()
    partial = root / f"{key}.{os.getpid()}.part"
    try:
        if sum(path.stat().st_size for path in files) > MOST_BYTES:
            return
        partial.mkdir(parents=True)
        for path in files:
            _link(path, partial / path.name)
        sums = {path.name: _sum(path) for path in files}
        (partial / _SUMS).write_text(json.dumps(sums, indent=1), encoding="utf-8")
        partial.rename(root / key)
        _evict(root)
    except OSError as error:
        log.info("the terrain is not kept in %s: %s", root, error.strerror or error)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def keep_beside(key: str, file: Path) -> None:
    """Keep one more file of a kept terrain, which follows from it and took long to find."""
    folder = kept_root() / key
    try:
        with _locked(folder):
            sums = json.loads((folder / _SUMS).read_text(encoding="utf-8")) | {file.name: _sum(file)}
            _link(file, folder / file.name)
            partial = folder / f"{_SUMS}.part"
            partial.write_text(json.dumps(sums, indent=1), encoding="utf-8")
            partial.replace(folder / _SUMS)
    except (OSError, ValueError, TypeError) as error:
        log.info("%s is not kept in %s: %s", file.name, folder, error)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    itself = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(itself, fcntl.LOCK_EX)
        yield
    finally:
        os.close(itself)


def _evict(root: Path) -> None:
    """Drop what was used longest ago, down to `MOST_BYTES`, and what a killed process began to keep."""
    left = MOST_BYTES
    for folder in sorted(root.iterdir(), key=lambda each: each.stat().st_mtime, reverse=True):
        left -= sum(path.stat().st_size for path in folder.iterdir())
        abandoned = folder.suffix == ".part" and time.time() - folder.stat().st_mtime > _ABANDONED_S
        if left < 0 or abandoned:
            shutil.rmtree(folder, ignore_errors=True)


def _link(source: Path, to: Path) -> None:
    to.unlink(missing_ok=True)
    try:
        os.link(source, to)
    except OSError:  # another file system
        shutil.copyfile(source, to)


def _sum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=16)).hexdigest()
