"""What is written for Kubernetes: manifests, and where there are files of the ground, a recipe for their image."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from launch_scripts.deploy.certificates import private_file
from launch_scripts.deploy.containers.container import SETTINGS, image_name
from launch_scripts.deploy.containers.kubernetes import SECRETS, kubernetes_files
from launch_scripts.deploy.host_scenario import CERTIFICATES, GROUND, PLUGINS, host_scenario, plugin_files
from launch_scripts.deploy.kits import certificates_of, for_operators, keep_plan, with_parts
from launch_scripts.deploy.plan import Plan
from launch_scripts.observe.files import replacing
from swarm.errors import StoreError

RECIPE = "Containerfile"
_OPEN = 0o644
_RECIPE = """\
# The images of this run, of the roles and of the monitor:
#     podman build --tag IMAGE . && podman build --build-arg BASE={base}-all --tag IMAGE-all .
ARG BASE={base}
FROM ${{BASE}}
{copies}"""


def write_cluster(plan: Plan, out: Path, days: int, image: str = "") -> Path:
    """Writes `out/kubernetes` and returns it; certificates are made in `out/certs` as for other kits.

    A pod may run on any node, so the ground's files and plug-ins, if there are any, belong into the image: their
    folder has a recipe that adds them to `image`'s base. Raises StoreError where a file cannot be read or written.
    """
    folder, revoked = out / CERTIFICATES, for_operators(out, days)
    certificates: dict[str, Path] = {}
    for host in plan.hosts:
        certificates |= certificates_of(folder, host, days, revoked)
    added = dict(with_parts({**_ground(plan), **plugin_files(plan.scenario)}))
    texts = kubernetes_files(plan, lambda name: certificates[f"{CERTIFICATES}/{name}"].read_bytes(), image, revoked)
    if added:
        places = sorted({place.partition("/")[0] for place in added})
        copies = "".join(f"COPY {place} {SETTINGS}/{place}\n" for place in places)
        texts[RECIPE] = _RECIPE.format(base=image_name(), copies=copies)
    cluster = out / "kubernetes"
    try:
        _write(cluster, texts, added)
    except OSError as error:
        raise StoreError(f"cannot write {cluster}: {error.filename or out}: {error.strerror or error}") from error
    keep_plan(plan, out)
    return cluster


def _ground(plan: Plan) -> dict[str, Path]:
    return {place: file for host in plan.hosts for place, file in host_scenario(plan, host)[1].items()}


def _write(cluster: Path, texts: Mapping[str, str], added: Mapping[str, Path]) -> None:
    """Each file whole or not at all; what an earlier plan added to the image and this one does not, goes."""
    cluster.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        with private_file(cluster / name) as file:
            file.write(text.encode())
        if name != SECRETS:
            (cluster / name).chmod(_OPEN)
    for place, source in added.items():
        (cluster / place).parent.mkdir(parents=True, exist_ok=True)
        with replacing(cluster / place) as partial:
            shutil.copyfile(source, partial)
    kept = {cluster / name for name in (*texts, *added)}
    for path in (cluster / RECIPE, *(cluster / GROUND).rglob("*"), *(cluster / PLUGINS).rglob("*")):
        if path.is_file() and path not in kept:
            path.unlink()
