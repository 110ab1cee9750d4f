"""Builders share the work, planners find what they compiled, and no kernel is forgotten."""

import os
import sys
from pathlib import Path
from typing import Any

import pytest
from support.processes import words_of_python

from planner_service import kernel_build
from planner_service.any_angle_routes import pulls
from planner_service.kernel_build import KernelLoader, all_kernels, name_of, needed_kernels
from planner_service.kernels.decorators import KERNELS
from shared_map.terrain.terrain import build_terrain
from shared_map.vehicle_class_grounds import class_terrains
from swarm.config.scenario import Scenario
from swarm.config.scenario_files import parse_scenario
from swarm.config.vehicle_classes import GROUND, first_classes


def test_every_kernel_of_a_planner_is_built() -> None:
    built = [name_of(kernel) for kernel in all_kernels()]
    assert sorted(built) == sorted(KERNELS.keys() - {"breadth_first"})  # of a benchmark


def scenario(*, directional: bool = False, aloft: int = 0, routes: str = "grid") -> Scenario:
    """On any ground, with a class that drives; 1 aloft: with one that flies, 2: a group flies."""
    return parse_scenario(
        f"""
terrain = {{ source = "synthetic", rows = 24, cols = 24, roads = 0 }}
cost = {{ directional = {str(directional).lower()} }}
planner = {{ routes = "{routes}" }}
[[classes]]
name = "truck"
max_speed_m_per_s = 5.0
"""
        + '[[classes]]\nname = "drone"\nair = {}\n' * min(aloft, 1)
        + '[[groups]]\nclass = "drone"\n' * (aloft - 1)
    )


@pytest.mark.parametrize("directional", [False, True])
@pytest.mark.parametrize("aloft", [0, 1, 2])
@pytest.mark.parametrize("routes", ["grid", "pulled"])
def test_what_is_compiled_is_what_the_grounds_of_a_scenario_take(directional, aloft, routes):
    """By the terrains themselves, as planners come by their kernels."""
    given = scenario(directional=directional, aloft=aloft, routes=routes)
    needed = needed_kernels(given)
    terrain = build_terrain(given)
    climbs = {GROUND: terrain.climb, **{k: v.climb for k, v in class_terrains(given, terrain).items()}}
    growths = {False: "grow_by_levels", True: "grow_by_levels_directed"}
    mends = {False: "mend", True: "mend_directed"}
    pulled = {False: "pull_routes", True: "pull_routes_directed"}
    first, later = set(map(name_of, needed.first)), set(map(name_of, needed.later))
    assert first & set(growths.values()) == {growths[climbs[name] is not None] for name in first_classes(given)}
    assert (first | later) & set(growths.values()) == {growths[climb is not None] for climb in climbs.values()}
    assert later & set(mends.values()) == {mends[climb is not None] for climb in climbs.values()}
    straight = {name: climb for name, climb in climbs.items() if pulls(given.planner, climb)}
    assert (first | later) & set(pulled.values()) == {pulled[climb is not None] for climb in straight.values()}
    at_first = {pulled[climb is not None] for name, climb in straight.items() if name in first_classes(given)}
    assert first & set(pulled.values()) == at_first
    assert len(list(needed)) == len(set(map(name_of, needed)))


def test_the_first_route_waits_for_the_kernels_of_classes_that_vehicles_belong_to_and_of_no_others() -> None:
    plain, mixed = needed_kernels(scenario()), needed_kernels(scenario(aloft=1))
    assert mixed.first == plain.first
    assert set(mixed.later) > set(plain.later)
    assert first_classes(scenario(aloft=2)) == {GROUND, "truck", "drone"} > first_classes(scenario(aloft=1))


_KERNELS = "\n\n\n".join(f'@kernel("(i8,)")\ndef k{n}(x):\n    return x + {n}' for n in range(6))
_SCRIPT = f"""
import os, sys, time
from planner_service.kernel_build import build, is_building
from planner_service.kernels import decorators
from planner_service.kernels.decorators import is_loaded, kernel, load
{_KERNELS}
all = [k0, k1, k2, k3, k4, k5]
assert decorators.cache_folder() is not None
"""
_SEVERAL = (
    _SCRIPT
    + """
assert not is_building()
children = []
for n in range(3):
    if not (pid := os.fork()):
        told = []
        build(all, told.append)
        assert sorted(each.__name__ for each in told) == [f"k{n}" for n in range(6)], told
        assert not any(load(each, compiling=False) is False for each in all)
        compiled = sum(sum(each.stats.cache_misses.values()) for each in all)
        print(f" {compiled} ", end="", flush=True)  # in one piece
        os._exit(0)
    children.append(pid)
for pid in children:
    assert os.waitpid(pid, 0)[1] == 0
assert not any(map(is_loaded, all)) and all[5](1) == 6
assert sum(all[5].stats.cache_hits.values()) == 1
"""
)
_KILLED = (
    _SCRIPT
    + """
import shutil, signal
import planner_service.kernel_build as kb
if not (pid := os.fork()):
    kb.load = lambda each: time.sleep(60)
    build(all)
while not is_building():
    time.sleep(0.01)
os.kill(pid, signal.SIGKILL)
os.waitpid(pid, 0)
shutil.rmtree(decorators.cache_folder())  # somebody clears the cache
assert not is_building()
build(all)
print(sum(map(is_loaded, all)))
"""
)


def run(tmp_path: Path, script: str) -> list[str]:
    (tmp_path / "several.py").write_text(script)  # numba keeps code of files only
    paths = f"{tmp_path}:{Path(kernel_build.__file__).parents[1]}"
    return words_of_python("import several", NUMBA_CACHE_DIR=str(tmp_path / "cache"), PYTHONPATH=paths)


def test_three_builders_compile_each_kernel_once_and_all_of_them_see_each(tmp_path: Path) -> None:
    misses = run(tmp_path, _SEVERAL)
    assert len(misses) == 3
    assert sum(map(int, misses)) == 6


def test_what_a_killed_builder_had_claimed_is_compiled_by_another(tmp_path: Path) -> None:
    assert run(tmp_path, _KILLED) == ["6"]


class Disk:
    """Stands for the compiled code: names that can be loaded."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.there: set[str] = set()
        self.started = 0
        self.options: list[str] = []
        self.building = False
        monkeypatch.setattr(kernel_build, "load", lambda each, compiling=True: name_of(each) in self.there)
        monkeypatch.setattr(kernel_build, "is_building", lambda: self.building)
        monkeypatch.setattr(kernel_build, "can_build", lambda: True)
        monkeypatch.setattr(kernel_build.subprocess, "Popen", self.start)
        monkeypatch.setattr(kernel_build.time, "sleep", self.sleep)
        self.coming: list[str] = []

    def start(self, command: list[str]) -> None:
        assert command[1:3] == ["-m", "planner_service.kernel_build"]
        self.options = command[3:]
        self.started += 1
        self.building = True

    def sleep(self, _: float) -> None:
        if self.coming:
            self.there.add(self.coming.pop(0))


def test_a_planner_starts_with_its_first_kernels_and_has_all_once_the_last_is_there(monkeypatch):
    disk = Disk(monkeypatch)
    needed = needed_kernels(scenario(aloft=1))
    disk.coming = [name_of(kernel) for kernel in needed.first]
    loader = KernelLoader(needed, whole=False)
    loader.load_first()
    assert not disk.coming
    assert disk.started >= 1, "nobody was building"
    assert disk.options == [name_of(kernel) for kernel in needed], "in the order in which they are needed"
    assert not loader.complete
    disk.coming = [name_of(kernel) for kernel in needed.later]
    loader._thread.join()
    assert loader.complete


def test_no_one_starts_builders_where_some_are_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(monkeypatch)
    disk.building = True
    needed = needed_kernels(scenario())
    disk.coming = [name_of(kernel) for kernel in needed]
    loader = KernelLoader(needed, whole=True)
    loader.load_first()
    assert loader.complete
    assert not disk.started


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ([], all_kernels()),
        (["mend", "arrivals"], [*filter(lambda kernel: name_of(kernel) in ("mend", "arrivals"), all_kernels())]),
    ],
)
def test_a_builder_by_hand_builds_what_is_named_or_all(options, wanted, monkeypatch):
    built: list[Any] = []
    monkeypatch.setattr(kernel_build, "build", built.extend)
    monkeypatch.setattr(kernel_build, "is_loaded", lambda _: False)
    monkeypatch.setattr(os, "nice", lambda _: 0)
    monkeypatch.setattr(sys, "argv", ["kernel_build", *options])
    kernel_build.main()
    assert [*map(name_of, built)] == [*map(name_of, wanted)]
    monkeypatch.setattr(kernel_build, "can_build", lambda: False)  # no process would find the results
    kernel_build.main()
    assert len(built) == len(wanted)
    monkeypatch.setattr(sys, "argv", ["kernel_build", "nothing"])
    with pytest.raises(SystemExit, match="expected names of kernels, found 'nothing'"):
        kernel_build.main()
