"""The version of a build: that of pyproject.toml, with the commit where git knows it, as in 0.2.0+g1a2b3c4d5e6f.

An editable installation outlives its commit, so `launch_scripts/install.sh` sets SWARM_COMMIT to nothing.
"""

import os
import shutil
import subprocess
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class Commit(MetadataHookInterface):
    def update(self, metadata: dict[str, Any]) -> None:
        commit = os.environ.get("SWARM_COMMIT", None if shutil.which("git") else "")
        if commit is None:
            asked = ["git", "-C", self.root, "rev-parse", "--short=12", "HEAD"]
            commit = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
        metadata["version"] = self.config["version"] + (f"+g{commit}" if commit else "")
