"""Plain formats: right files are read, and wrong ones are refused with the line."""

from pathlib import Path

import numpy as np
import pytest
from support.height_models import written

from shared_map.importers.terrain_sources import Source, load_source
from shared_map.terrain.terrain import build_terrain
from swarm.config.ground import CostConfig, TerrainConfig
from swarm.config.scenario import Scenario
from swarm.errors import TerrainError

ASC = "ncols 3\nnrows 2\nxllcorner 1000\nyllcorner 2000\ncellsize 50\nNODATA_value -9999\n1 2 3\n4 -9999 6\n"
GRASS = "north: 20\nsouth: 0\neast: 30\nwest: 0\nrows: 2\ncols: 3\n"
MAP = "type octile\nheight 3\nwidth 4\nmap\n..@T\nGS.W\nO...\n"
YAML = "image: m.pgm  # the picture\nresolution: 0.05\norigin: [-1.0, -2.0, 0.0]\nnegate: 0\n"
YAML += "occupied_thresh: 0.65\nfree_thresh: 0.25\n"


def load(path: Path, text: str | bytes | None = None, **settings: object) -> Source:
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load_source(TerrainConfig(source=str(path), **settings), seed=1)


BAD: dict[str, list[tuple[str | bytes, str]]] = {
    "a.asc": [
        (ASC.replace("ncols 3", "ncols 2.5"), "its header says ncols '2.5', expected a whole number"),
        (ASC.replace("ncols 3", "ncols 3x"), "its header says ncols '3x', expected a whole number"),
        (ASC.replace("cellsize 50", "cellsize 5_0"), "its header says cellsize '5_0', expected a number"),
        (ASC.replace("cellsize 50", "cellsize 50\ncellsize 60"), "its header says cellsize twice"),
        (ASC.replace("1 2 3", "1 2_0 3"), "line 7: found '2_0'; its header says 2 rows of 3 numbers"),
        (ASC.replace("ncols 3", "ncols nan"), "Invalid dataset dimensions : 0 x 2"),
        (ASC.replace("cellsize 50", "cellsize inf"), "has pixels without a size"),
        (ASC.replace("1 2 3", "1 2"), "has 5 numbers; its header says 2 rows of 3"),
        (ASC.replace("4 -9999 6\n", ""), "has 3 numbers; its header says 2 rows of 3"),
        (ASC.replace("4 -9999 6", "4 x 6"), "line 8: found 'x'; its header says 2 rows of 3 numbers"),
        (ASC + "7 8 9\n", "line 9: found '7'; its header says 2 rows of 3 numbers"),
        (ASC.replace("ncols 3\n", ""), "is truncated or no raster"),
        (ASC.replace("cellsize 50", "cellsize 0"), "a cell 0 x 0, expected a size above 0"),
        (ASC.replace("ncols 3", "ncols 300000").replace("nrows 2", "nrows 300000"), "300000 x 300000"),
        (
            ASC.replace("cellsize 50", "cellsize 0.001").replace("1000", "9").replace("2000", "47"),
            "looks like degrees",
        ),
        (ASC.replace("xllcorner", "xllcenter"), "its header needs xllcorner and yllcorner"),
        (GRASS + "multiplier: 0.01\n1 2 3\n4 5 6", "a multiplier"),
        (ASC.replace("cellsize 50", "cellsize -50"), "a cell -50 x -50, expected a size above 0"),
        (ASC.replace("cellsize 50", "dx 50\ndy 0"), "a cell 50 x 0, expected"),
        (GRASS.replace("north: 20", "north: -20") + "1 2 3\n4 5 6", "a cell 10 x -10, expected"),
        ("DSAA\n3 2\n60 0\n0 30\n1 6\n1 2 3\n4 5 6", "a cell -30 x 30, expected"),
        (
            "north: 46:30N\nsouth: 45:00N\neast: 9E\nwest: 8E\nrows: 2\ncols: 3\n1 2 3\n4 5 6",
            "north '46:30N', expected a number",
        ),
        (b"\xfd\xfe\x00", "is no raster that is read: it begins with .*gdal_translate"),
        ("", "is empty; it is not read; fetch the file again"),
    ],
    "a.map": [
        (MAP.replace("GS.W", "GS."), "line 6: 3 cells; expected 3 rows of 4"),
        (MAP.replace("O...\n", ""), "2 rows; its header says 3"),
        (MAP.replace("O...", "O.x."), "line 7, column 3: 'x' is no ground"),
        (MAP.replace("height 3", "height many"), "no MovingAI map"),
        (MAP.replace("height 3", "height 99999999").replace("width 4", "width 9999"), "has 99999999 x 9999 cells"),
        ("hello", "no MovingAI map"),
    ],
}


@pytest.mark.parametrize(("name", "text", "words"), [(name, *each) for name, bad in BAD.items() for each in bad])
def test_a_bad_file_is_refused_with_a_sentence(tmp_path: Path, name: str, text: str | bytes, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        load(tmp_path / name, text)


def test_a_bad_npz_is_refused_with_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    for arrays, words in (
        ({"height": np.ones((3, 3))}, r"no `elevation` \(read: .*resolution_m.*\); it has height"),
        ({"elevation": np.ones(3)}, r"elevation is \(3,\) float64; expected rows of numbers"),
        ({"elevation": np.ones((3, 3))}, "does not say how large a cell is; set terrain.resolution_m"),
        ({"elevation": np.ones((3, 3)), "resolution_m": -1.0}, "must be positive"),
        ({"elevation": np.array([["a", "b"]])}, "expected rows of numbers"),
        ({"elevation": np.ones((3, 3)), "resolution_m": [1, 2]}, "its cell size is no single number"),
        ({"elevation": np.ones((3, 3)), "resolution_m": "a"}, "its cell size is no single number"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(TerrainError, match=words):
            load(path)
    np.savez(path, elevation=np.random.default_rng(1).normal(size=(50, 50)), resolution_m=1.0)
    with pytest.raises(TerrainError, match=r"truncated or no \.npz"):
        load(path, path.read_bytes()[:9000])
    with pytest.raises(TerrainError, match=r"truncated or no \.npz"):
        load(path, b"PK nonsense")


def test_an_npz_names_the_arrays_which_are_not_read_and_that_no_system_can_place_it(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", elevation=np.eye(20), resolution_m=10.0, west_m=500_000.0)
    said = "\n".join(load(tmp_path / "a.npz", crs="EPSG:32632").notes)
    assert "! not read: the arrays west_m (read: elevation" in said
    assert "! the file has no origin" in said


def test_an_hgt_is_known_by_its_length(tmp_path: Path) -> None:
    heights = np.full((1201, 1201), 700, ">i2")
    heights[0, 0] = -32768
    source = load(tmp_path / "N46E009.hgt", heights.tobytes())
    assert 70 < source.grid.resolution_m < 93
    assert np.nanmedian(source.elevation_m) == 700


def test_a_png_needs_a_scale(tmp_path: Path) -> None:
    grey = (np.arange(48).reshape(6, 8) * 100).astype(np.uint16)
    written(tmp_path / "a.png", grey, "uint16", driver="PNG", crs=None, transform=None)
    with pytest.raises(TerrainError, match=r"set terrain\.resolution_m .* terrain\.height_scale"):
        load(tmp_path / "a.png")
    source = load(tmp_path / "a.png", resolution_m=5.0, height_scale=0.1)
    np.testing.assert_allclose(source.elevation_m, grey * 0.1, rtol=1e-6)


# --- maps without heights -----------------------------------------------------------------------------------


def test_a_movingai_map_is_open_or_lethal_cell_by_cell(tmp_path: Path) -> None:
    (tmp_path / "a.map").write_text(MAP)
    source, cost = TerrainConfig(source=str(tmp_path / "a.map")), CostConfig(flat_speed_m_per_s=4.0)
    terrain = build_terrain(Scenario(terrain=source, cost=cost))
    lethal = np.array([[0, 0, 1, 1], [0, 0, 0, 1], [1, 0, 0, 0]], bool)
    np.testing.assert_array_equal(np.isinf(terrain.pace_s_per_m), lethal)
    assert (terrain.pace_s_per_m[~lethal] == 0.25).all()
    assert terrain.grid.resolution_m == 1


def ros(folder, yaml=YAML, image=b"P5\n# made by hand\n3 2\n255\n\xfe\x00\xcd\xfe\xfe\x00"):
    (folder / "m.pgm").write_bytes(image)
    return load(folder / "m.yaml", yaml)


def test_a_ros_map_keeps_row_0_on_top_and_unknown_is_lethal(tmp_path: Path) -> None:
    source = ros(tmp_path)
    np.testing.assert_array_equal(source.factor, np.array([[1, np.inf, 1], [1, 1, np.inf]], np.float32))
    assert (source.grid.resolution_m, source.grid.west_m, source.grid.north_m) == (0.05, -1.0, -1.9)
    unknown = ros(tmp_path, YAML.replace("0.25", "0.1"))
    assert np.isinf(unknown.factor[0, 2])
    (tmp_path / "m.yaml").write_text(YAML.replace("0.25", "0.1"))
    assert load(tmp_path / "m.yaml", nodata="fill").factor[0, 2] == 1


def test_ros_modes_scale_raw_and_negate(tmp_path: Path) -> None:
    scaled = ros(tmp_path, YAML + "mode: scale\n", b"P2 3 1 # wide\n100\n100 55 20\n").factor
    assert scaled[0, 0] == 1
    assert 1 < scaled[0, 1] < 10
    assert np.isinf(scaled[0, 2])
    raw = ros(tmp_path, YAML + "mode: raw\n", b"P5 3 1 255\n\x00\x64\xff").factor
    np.testing.assert_array_equal(raw, np.array([[1, np.inf, np.inf]], np.float32))
    turned = ros(tmp_path, YAML.replace("negate: 0", "negate: 1"), b"P5 2 1 255\n\x00\xff").factor
    np.testing.assert_array_equal(turned, np.array([[1, np.inf]], np.float32))
    wide = ros(tmp_path, YAML, b"P5 2 1 65535\n\xff\xff\x00\x00").factor
    np.testing.assert_array_equal(wide, np.array([[1, np.inf]], np.float32))


@pytest.mark.parametrize(
    ("yaml", "image", "words"),
    [
        (YAML.replace("m.pgm", "n.pgm"), b"", r"cannot read image .*n\.pgm: No such file"),
        (YAML, b"P9 1 1 255\n\0\0\0", "no PGM, PNG or BMP"),
        (YAML, b"P5 100 100 255\n\0\0", "is truncated"),
        (YAML, b"P5 99999 99999 255\n\0", "is truncated or no PGM.*decompression bomb"),
        (YAML, b"P5 a b 255\n\0", "invalid literal"),
        (YAML, b"P2 2 1 255\n1 x\n", "no PGM"),
        (YAML, b"P5 2 1 0\n\0\0", "maxval must be greater than 0"),
        (YAML.replace("resolution: 0.05\n", ""), b"P5 1 1 255\n\0", "missing required field `resolution`"),
        (YAML.replace("0.05", "wide"), b"P5 1 1 255\n\0", "wide"),
        (YAML.replace("-1.0", ".nan"), b"P5 1 1 255\n\0", "origin.0.: found nan"),
        (YAML.replace("0.0]", "0.7]"), b"P5 1 1 255\n\0", "turned by 0.7 rad"),
        (YAML + "mode: fancy\n", b"P5 1 1 255\n\0", "mode: found 'fancy'; allowed"),
        ("- a\n", b"P5 1 1 255\n\0", "map: missing required field `image`"),
        (YAML + "what is this\n", b"P5 1 1 255\n\0", "line 7"),
        (YAML.replace("0.25", "0.9"), b"P5 1 1 255\n\0", "free <= occupied"),
    ],
)
def test_a_bad_ros_map_is_refused_with_a_sentence(tmp_path: Path, yaml: str, image: bytes, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        ros(tmp_path, yaml, image)
