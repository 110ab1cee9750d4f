"""The law of files: whatever lies in a file that a command reads, it is read, or refused in one sentence with an
exit code; soon, and with little memory."""

import io
import itertools
import json
import os
import resource
import select
import socket
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.effort import few
from support.height_models import written

from shared_map.importers.cover.classify import read_labels
from shared_map.importers.terrain_sources import load_source
from swarm.config.ground import TerrainConfig
from swarm.config.input_files import parse_toml
from swarm.config.scenario_files import load_scenario
from swarm.errors import ConfigError, SwarmError
from swarm.grid import GridSpec

COMMANDS = """
import json, os, re, sys
from launch_scripts.cli import main
import shared_map.importers.terrain_sources
for line in sys.stdin:
    command, output = json.loads(line)
    child = os.fork()
    if not child:
        said = os.open(output, os.O_CREAT | os.O_WRONLY)
        os.dup2(said, 1)
        os.dup2(said, 2)
        sys.argv[1:] = command
        try:
            code = main()
        except SystemExit as end:
            code = end.code or 0
        sys.stdout.flush()
        sys.stderr.flush()
        # Not `ru_maxrss`: that counts what the process was forked from.
        peak_mb = int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) >> 10
        print("PEAK", peak_mb, flush=True)
        os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""Each command in a process of its own, forked from one that has loaded what all of them take: that takes longer
than to refuse a file."""

MOST_MB = 400
"""Memory bound of a command that refuses its input. It takes 150 with the libraries of rasters."""


def npy(shape: tuple[int, ...], descr: str = "<f4", body: bytes = b"") -> bytes:
    head = str({"descr": descr, "fortran_order": False, "shape": shape}).encode() + b" " * 20 + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + body


def archive(path: Path, **members: bytes | int) -> Path:
    """An .npz file; a number stands for that many megabytes of zeros after the head of their array."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            with file.open(f"{name}.npy", "w", force_zip64=True) as member:
                if isinstance(content, bytes):
                    member.write(content)
                    continue
                member.write(npy((content << 20,), "|u1"))
                for _ in range(content):
                    member.write(bytes(1 << 20))
    return path


def sparse(path: Path, head: bytes = b"", length: int = 20 << 30) -> Path:
    """A file of which only the head takes space on the disk."""
    with path.open("wb") as file:
        file.write(head)
        file.truncate(length)
    return path


def raster(path: Path, rows: int, cols: int, **how: object) -> Path:
    import rasterio
    from rasterio.transform import from_origin

    where = {"crs": "EPSG:32632", "transform": from_origin(5e5, 5e6, 0.01, 0.01), "SPARSE_OK": True}
    with rasterio.open(
        path, "w", driver="GTiff", count=1, dtype="float32", height=rows, width=cols, **where, **how
    ):
        pass
    return path


Run = Callable[..., tuple[int, str, int]]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """(exit code, all that was said, megabytes at most) of a command of `swarm`."""
    folder = tmp_path_factory.mktemp("said")
    numbers = itertools.count()
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # no thread before a fork
    with subprocess.Popen(
        [sys.executable, "-c", COMMANDS],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    ) as commands:

        def run(*arguments: object) -> tuple[int, str, int]:
            output = folder / f"{next(numbers)}.txt"
            assert commands.stdin is not None
            assert commands.stdout is not None
            print(json.dumps([list(map(str, arguments)), str(output)]), file=commands.stdin, flush=True)
            code = int(commands.stdout.readline())
            said, _, peak_mb = output.read_text().rpartition("PEAK")
            return code, said, int(peak_mb)

        yield run
        commands.kill()


TOML = {
    "brackets": "a = " + "[" * 100_000 + "]" * 100_000,
    "dotted": ".".join(["a"] * 100_000) + " = 1",
    "headers": "[" + ".".join(["a"] * 3000) + "]\n" + "".join(f"k{i}=1\n" for i in range(20_000)),
    "digits": "seed = " + "9" * 5000,
    "hexadecimal": "seed = 0x" + "f" * 400_000,
    "targets": "".join(f'[[targets]]\nname="t{i}"\n' for i in range(20_000)),
    "counts": "".join(f'[[targets]]\ncount=1000\nname="t{i}"\n' for i in range(300)),
    "key": "a" * 400_000 + " = 1",
    "value": f"name = '{'a' * 400_000}'",
}


@pytest.mark.parametrize("text", TOML.values(), ids=TOML)
def test_a_scenario_that_explodes_is_refused_in_a_short_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_scenario(path)
    assert str(path) in str(refused.value)
    assert len(str(refused.value)) < 600


def test_endless_and_huge_files_are_refused_by_a_look(tmp_path: Path, run: Run) -> None:
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    for path in (tmp_path / "zero.toml", sparse(tmp_path / "huge.toml")):
        code, said, peak_mb = run("up", path, "--runs", tmp_path)
        sentences = [line for line in said.splitlines() if not line.startswith("loading, ")]  # on a busy machine
        assert (code, len(sentences)) == (2, 1), said
        assert f"swarm: cannot read scenario {path}: it " in sentences[0]
        assert peak_mb < MOST_MB


BOMBS: dict[str, Callable[[Path], Path]] = {
    "elevation of 5 GB": lambda p: archive(p / "a.npz", elevation=npy((1 << 16, 1 << 16))),
    "elevation of 2 TB": lambda p: archive(p / "a.npz", elevation=npy((1 << 20, 1 << 20))),
    "objects": lambda p: archive(p / "a.npz", elevation=npy((2, 2), "|O", b"abc")),
    "long text": lambda p: archive(p / "a.npz", elevation=npy((2, 2), "|S2147483647")),
    "nested header": lambda p: archive(p / "a.npz", elevation=b"\x93NUMPY\x01\0\x28\x23" + b"(" * 8999 + b"\n"),
    "not so long": lambda p: archive(p / "a.npz", elevation=npy((8000, 8000), "<f4", bytes(1 << 20))),
    "members": lambda p: archive(p / "a.npz", **{f"m{n}": b"" for n in range(30_000)}),
    "asc": lambda p: sparse(p / "a.asc", b"ncols 10\n"),
    "line": lambda p: sparse(p / "a.asc", b"ncols 10\nnrows 10\ncellsize 10\n", 1 << 30),
    "map": lambda p: sparse(p / "a.map", b"type octile\nheight 3\nwidth 4\nmap\n"),
    "yaml": lambda p: sparse(p / "a.yaml"),
    "vrt": lambda p: sparse(p / "a.vrt", b"<VRTDataset"),
    "pixels": lambda p: raster(p / "a.tif", 200_000, 200_000, tiled=True, compress="deflate"),
    "one block": lambda p: raster(p / "a.tif", 16_000, 16_000, compress="deflate", blockysize=16_000),
}


@pytest.mark.parametrize("make", BOMBS.values(), ids=BOMBS)
def test_a_terrain_that_explodes_is_refused_in_a_sentence(
    tmp_path: Path, run: Run, make: Callable[[Path], Path]
) -> None:
    path = make(tmp_path)
    code, said, peak_mb = run("terrain", "info", path, "--resolution-m", 10)
    assert code == 3, said
    assert "Traceback" not in said
    assert str(path) in said
    assert peak_mb < MOST_MB


def test_a_member_that_no_one_asked_for_is_not_unpacked(tmp_path: Path, run: Run) -> None:
    small = npy((8, 8), body=bytes(256))
    path = archive(tmp_path / "a.npz", elevation=small, x=300)
    code, said, peak_mb = run("terrain", "info", path, "--resolution-m", 10)
    assert code == 0, said
    assert peak_mb < MOST_MB


def test_a_raster_that_names_others_reaches_nothing_on_the_network(tmp_path: Path, run: Run) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        path = tmp_path / "a.vrt"
        path.write_text(
            '<VRTDataset rasterXSize="9" rasterYSize="9"><SRS>EPSG:32632</SRS><GeoTransform>0,9,0,0,0,-9'
            '</GeoTransform><VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename>/vsicurl/'
            f"http://127.0.0.1:{server.getsockname()[1]}/x.tif</SourceFilename></SimpleSource></VRTRasterBand>"
            "</VRTDataset>"
        )
        code, said, _ = run("terrain", "info", path)
        assert code == 3, said
        assert not select.select([server], [], [], 0)[0], "somebody has connected"


# --- flipped, cut, mixed -----------------------------------------------------------------------------------


def _seeds() -> dict[str, bytes]:
    from rasterio.io import MemoryFile
    from rasterio.transform import from_origin

    heights = np.arange(64, dtype=np.float32).reshape(8, 8)
    packed = io.BytesIO()
    np.savez_compressed(packed, elevation=heights, resolution_m=10.0)
    with MemoryFile(ext=".tif") as memory:
        written(memory.name, heights, compress="deflate", transform=from_origin(5e5, 5e6, 10, 10))
        tiff = bytes(memory.getbuffer())
    return {
        "a.npz": packed.getvalue(),
        "a.tif": tiff,
        "a.asc": b"ncols 3\nnrows 2\nxllcorner 1000\nyllcorner 2000\ncellsize 50\n1 2 3\n4 -9999 6\n",
        "a.map": b"type octile\nheight 3\nwidth 4\nmap\n..@T\nGS.W\nO...\n",
        "a.yaml": b"image: a.pgm\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\noccupied_thresh: 0.65\n"
        b"free_thresh: 0.25\n",
        "a.pgm": b"P5\n# made by hand\n3 2\n255\n\xfe\x00\xcd\xfe\xfe\x00",
        "a.toml": b'seed = 3\n[terrain]\nsource = "synthetic"\nrows = 60\n[[targets]]\nstart = [3, 4]\n',
        "labels.toml": b'[[labels]]\nclass = "water"\npolygon_m = [[0, 0], [40, 0], [40, 40]]\n'
        b'[[labels]]\nclass = "grass"\npoints_m = [[55, 55]]\n',
    }  # fmt: skip


SEEDS = _seeds()


def _read(path: Path) -> None:
    match path.name:
        case "a.toml":
            load_scenario(path)
        case "labels.toml":
            read_labels(path, GridSpec(8, 8, 10.0))
        case "a.pgm":
            path.with_name("a.yaml").write_bytes(SEEDS["a.yaml"])
            load_source(TerrainConfig(source=str(path.with_name("a.yaml"))), 1)
        case "a.tif" | "a.npz":
            load_source(TerrainConfig(source=str(path), resolution_m=10.0), 1)
        case _:
            load_source(TerrainConfig(source=str(path)), 1)


@pytest.mark.parametrize("name", SEEDS)
@settings(max_examples=few(150), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_flipped_cut_and_mixed_files_are_read_or_refused_in_a_line_per_fault(
    tmp_path: Path, name: str, data: st.DataObject
) -> None:
    content = bytearray(SEEDS[name])
    places = st.integers(0, len(content) - 1)
    for place, byte in data.draw(st.lists(st.tuples(places, st.integers(0, 255)), max_size=6)):
        content[place] = byte
    if data.draw(st.booleans()):
        at = data.draw(places)
        content[at : at + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    if data.draw(st.integers(0, 3)) == 0:
        del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path / name
    path.write_bytes(content)
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    faults: list[str] = []
    try:
        _read(path)
    except SwarmError as refused:
        faults = str(refused).split("\n")
    assert len(faults) <= 1 or (name == "a.toml" and all(each.startswith(str(path)) for each in faults))
    assert all(len(each) < 1000 for each in faults)
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10) - before_mb < MOST_MB


@settings(max_examples=few(300), deadline=None)
@given(
    st.lists(
        st.sampled_from(['"', "'", '"""', "'''", "\\", "[", "]", "{", "}", ".", "a", "=", "#", "\n", " ", ","])
    )
)
def test_no_text_gets_past_the_bounds_of_toml(parts: list[str]) -> None:
    """Parsed values nest no deeper than the bound: the scan sees the same text as the parser."""
    try:
        values = parse_toml("".join(parts), "x", ConfigError)
    except ConfigError:
        return
    assert len(repr(values)) < 10_000


def test_a_raster_with_a_name_inside_that_is_no_text_is_refused_in_one_line(tmp_path: Path) -> None:
    content = bytearray(SEEDS["a.tif"])
    content[326], content[342] = 1, 128  # in the name of its coordinate system
    path = tmp_path / "a.tif"
    path.write_bytes(content)
    with pytest.raises(
        SwarmError, match=r"^terrain .*a\.tif: its name, or a name in it or in its \.prj, is not UTF-8"
    ):
        _read(path)
