"""Plausible mistakes at the command line and in scenario files: each is answered with what to do, in a line or two.

The table was written before anybody looked at the answers. A mistake is made in this process, and no process of a
swarm may start because of one.
"""

import io
import re
import shlex
import socket
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from launch_scripts import ports
from launch_scripts.check import machine_check as machine
from launch_scripts.cli import main
from launch_scripts.commands import shared_options
from launch_scripts.deploy.certificates import issue
from launch_scripts.launcher import forkserver
from launch_scripts.launcher.forkserver import WarmUp
from launch_scripts.launcher.local_processes import LocalSwarm
from launch_scripts.ports import free_ports
from launch_scripts.process_table import certificate_names
from swarm.config.scenario_files import load_scenario

MISTAKES: list[dict[str, Any]] = tomllib.loads(
    Path(__file__).with_name("mistakes.toml").read_text(encoding="utf-8")
)["mistake"]

TINY = '[terrain]\nsource = "synthetic"\nrows = 24\ncols = 24\nrelief_m = 1\n[monitor]\nweb_port = 0\n'
LAKE = TINY + '[[cost.zones]]\nkind = "forbidden"\nmask = "lake.png"\n'
RING = TINY + '[[cost.zones]]\nkind = "forbidden"\nmask = "ring.png"\n'

WORDS_OF_LIBRARIES = re.compile(
    r"Traceback|`(int|float|str|bool|array|object|null|struct)|[Ee]xpected `|Object contains|Usage:|[╭│╰]|Errno|"
    r"msgspec|TOMLDecode|ValidationError|\$\.|CPLE_|ZError"
)
BUSY = re.compile(r"^(.*, \d+ s \.\.\.|open http://.*|from another computer: .*)\n", re.MULTILINE)
"""Output of a slow machine meanwhile."""
LONGEST_ANSWER = 400
"""Characters; two lines of a wide terminal."""


def port_taken(folder: Path, request: pytest.FixtureRequest) -> None:
    taken = socket.create_server(("127.0.0.1", 0))
    request.addfinalizer(taken.close)
    endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
    path = folder / "tiny.toml"
    path.write_text(f'{TINY}[network]\nlisten = ["{endpoint}"]\nconnect = ["{endpoint}"]\n')


def no_viewer(folder: Path, request: pytest.FixtureRequest) -> None:
    patch = request.getfixturevalue("monkeypatch")
    patch.setattr("swarm.errors.find_spec", lambda name: None if name == "rerun" else find_spec(name))


def two_machines(folder: Path, request: pytest.FixtureRequest) -> None:
    rows = (f'[[hosts]]\nname = "m{n}"\naddress = "10.0.0.{n}"\n' for n in (1, 2))
    (folder / "hosts.toml").write_text("".join(rows))


def photo(folder: Path, request: pytest.FixtureRequest) -> None:
    from rasterio.transform import from_origin
    from support.height_models import written

    pixels = np.random.default_rng(1).integers(0, 255, (3, 24, 24), np.uint8)
    place = from_origin(400000, 5000000, 10, 10)
    written(folder / "photo.tif", pixels, "uint8", photometric="RGB", transform=place)


def hill(folder: Path, request: pytest.FixtureRequest) -> None:
    np.savez(folder / "hill.npz", elevation=np.ones((24, 24), np.float32), resolution_m=10.0)


def certificates_of_another(folder: Path, request: pytest.FixtureRequest) -> None:
    certificates_but_one(folder, request)
    issue(folder / "certs", "planner.t", [], 9)
    issue(folder / "others", "operator.0", [], 9)
    (folder / "certs/ca.pem").write_bytes((folder / "others/ca.pem").read_bytes())


def certificates_but_one(folder: Path, request: pytest.FixtureRequest) -> None:
    for name in certificate_names(load_scenario(folder / "tiny.toml")):
        if name != "planner.t":
            issue(folder / "certs", name, ["localhost"] * name.startswith("router"), 9)


def latin_1(folder: Path, request: pytest.FixtureRequest) -> None:
    (folder / "s.toml").write_bytes('name = "H\u00fcgel"\n'.encode("latin-1"))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    import PIL.Image

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.txt").write_text("Dear diary, = today\n")
    (tmp_path / "tiny.toml").write_text(TINY + "[[groups]]\nvehicles = 3\n")
    row, col = np.mgrid[:24, :24]
    away = np.maximum(abs(row - 12), abs(col - 12))
    PIL.Image.fromarray(np.where(away <= 2, 255, 0).astype(np.uint8)).save(tmp_path / "lake.png")
    PIL.Image.fromarray(np.where(away == 2, 255, 0).astype(np.uint8)).save(tmp_path / "ring.png")
    return tmp_path


def _no_process(*args: object, **options: object) -> NoReturn:
    raise AssertionError("a process was started")


def name_of(mistake: dict[str, Any]) -> str:
    text = " ".join([mistake.get("do", ""), mistake.get("toml", ""), mistake.get("given", "")])
    return re.sub(r"\W+", "-", text.replace("\\n", " ")).strip("-")[:60]


@pytest.mark.parametrize("mistake", MISTAKES, ids=name_of)
def test_a_mistake_is_answered_with_what_to_do(
    mistake: dict[str, Any],
    place: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    monkeypatch.setattr(LocalSwarm, "start", _no_process)
    monkeypatch.setattr(forkserver, "start_forkserver", lambda *args: None)
    monkeypatch.setattr(WarmUp, "_run", lambda self: None)
    monkeypatch.setattr(shared_options, "_CONNECT_S", 0.3)
    # Neither who else listens here nor how large this machine is has a part in it.
    if mistake.get("given") != "port_taken":
        monkeypatch.setattr(ports, "_taken", lambda host, port: False)
    monkeypatch.setattr(machine, "this_machine", lambda runs: machine.Resources(64, 1 << 40, 1 << 50))
    if "toml" in mistake:
        text = mistake["toml"].replace("\\n", "\n")
        for name, begin in (("TINY", TINY), ("LAKE", LAKE), ("RING", RING)):
            text = text.replace(name, begin)
        (place / "s.toml").write_text(text)
    for name, text in mistake.get("files", {}).items():
        (place / name).write_text(text, encoding="utf-8")
    if "given" in mistake:  # the function of this name lays it out
        globals()[mistake["given"]](place, request)
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    line = mistake.get("do", "check s.toml").replace("PORT", str(free_ports(1)[0]))
    monkeypatch.setattr(sys, "argv", ["swarm", *shlex.split(line)])
    try:
        code = main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    said = BUSY.sub("", "".join(capsys.readouterr()))
    assert code != 0, said
    for word in mistake["answer"]:
        assert word.lower() in said.lower(), f"{word!r} is not in {said!r}"
    assert WORDS_OF_LIBRARIES.search(said) is None, said
    assert len(said.splitlines()) <= 2, said
    assert len(said) <= LONGEST_ANSWER, said
    assert not any(place.glob("runs/*")), "what was refused is no run, and leaves none"
    after = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    assert after == before, "what was refused writes nothing, and changes nothing"
