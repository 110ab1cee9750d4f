"""zenohd as a process of a test, where it is installed: in the folder that ZENOHD names, or on PATH."""

import json
import os
import shutil
from pathlib import Path

import pytest
from support.processes import Child, eventually

from launch_scripts.deploy.machine_archives import zenohd_config
from swarm.config.scenario import NetworkConfig
from swarm.endpoints import listening

PLUGIN = "libzenoh_plugin_storage_manager.so"


def zenohd() -> str:
    """Its path; skips where there is none."""
    root = os.environ.get("ZENOHD")
    found = shutil.which("zenohd", path=None if root is None else str(Path(root) / "bin"))
    if found is None:
        pytest.skip("there is no zenohd on PATH, and ZENOHD names no folder with bin/zenohd")
    return found


def plugins() -> str:
    """The folder of its storage-manager plugin; skips where there is none."""
    found = Path(zenohd())
    for folder in (found.parent, found.parents[1] / "lib"):
        if (folder / PLUGIN).is_file():
            return str(folder)
    pytest.skip(f"there is a zenohd, but no {PLUGIN} beside it or in ../lib")


class Zenohd(Child):
    """zenohd, under way, as `swarm deploy zenohd` configures it."""

    def __init__(self, folder: Path, network: NetworkConfig, plugins: str | None = None) -> None:
        config = folder / "zenohd.json5"
        config.write_text(json.dumps(zenohd_config(network, plugins=plugins)))
        super().__init__(folder / "zenohd.log", zenohd(), "-c", config)
        self.network = network
        eventually(lambda: listening(network.listen[0]), 20, "zenohd to listen")
