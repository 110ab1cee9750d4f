"""Land-cover maps: codes become classes by a table that is known, said, or asked for; never interpolated."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rasterio.transform import from_origin
from support.height_models import SIDE, hills, load, said, written

from shared_map.importers.cover.land_cover import TABLES, read_cover, read_cover_table
from shared_map.terrain.pace_layers import TerrainClass
from swarm.config.ground import TerrainConfig
from swarm.config.scenario_files import COVER_TABLES
from swarm.errors import TerrainError
from swarm.grid import GridSpec

EUROPE = "EPSG:32632"
PLACE = from_origin(500_000, 5_000_000, 20, 20)


def patches(codes: Any, seed: int = 1) -> Any:
    """Codes in patches, each on an equal share of SIDE x SIDE cells."""
    ground = hills(seed, 1.0)
    borders = np.quantile(ground, np.linspace(0, 1, len(codes) + 1)[1:-1])
    return np.array(codes)[np.digitize(ground, borders)]


def expected(codes: Any, key: str) -> tuple[Any, Any]:
    grounds = TABLES[key].grounds
    kinds = np.vectorize(lambda code: int(grounds[code].kind))(codes)
    return kinds, np.vectorize(lambda code: grounds[code].factor)(codes)


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    return written(tmp_path / "dem.tif", hills(1, 300))


# --- tables -------------------------------------------------------------------------------------------------


def test_the_setting_names_the_tables_that_there_are() -> None:
    assert tuple(TABLES) == COVER_TABLES
    sizes = {key: len(table.grounds) for key, table in TABLES.items()}
    assert sizes == {"worldcover": 11, "corine": 44, "corine-level-3": 44, "nlcd": 21}
    level3 = list(TABLES["corine-level-3"].grounds.values())
    assert [TABLES["corine"].grounds[n] for n in range(1, 45)] == level3


@pytest.mark.parametrize("key", list(TABLES))
@pytest.mark.parametrize("dtype", ["uint16", "float32"])
def test_codes_of_each_table_become_its_grounds(tmp_path: Path, dem: Path, key: str, dtype: str) -> None:
    codes = patches(list(TABLES[key].grounds))
    path = written(tmp_path / "cover.tif", codes, dtype, crs=EUROPE)
    source = load(dem, cover=str(path), cover_codes=None if key == "worldcover" else key)
    kinds, factors = expected(codes, key)
    np.testing.assert_array_equal(source.classes, kinds)
    np.testing.assert_allclose(source.factor, factors)
    assert said(source.notes, f"land cover: {TABLES[key].title}")


# --- which table ----------------------------------------------------------------------------------------------


def test_an_ambiguous_map_is_asked_for(tmp_path: Path) -> None:
    grid = GridSpec(SIDE, SIDE, 20.0, 500_000, 5_000_000, EUROPE)
    two = written(tmp_path / "a.tif", patches([11, 21, 31, 41, 42, 43]), "uint8")
    with pytest.raises(TerrainError, match=r"set terrain\.cover_codes = 'corine' or 'nlcd'$") as asked:
        read_cover(two, grid, TerrainConfig())
    assert "\n" not in str(asked.value)
    both = written(tmp_path / "c.tif", patches([10, 20, 30, 40]), "uint8")
    with pytest.raises(
        TerrainError, match=r"are those of ESA WorldCover, and of CORINE .*, and of GlobeLand30, and of"
    ):
        read_cover(both, grid, TerrainConfig())


@pytest.mark.parametrize("evidence", ["metadata", "file name"])
def test_a_table_is_known_by_what_the_file_says_of_itself(tmp_path: Path, dem: Path, evidence: str) -> None:
    codes = patches([11, 21, 31, 41, 42, 43])
    name, title = (
        ("nlcd_2021.tif", "") if evidence == "file name" else ("a.tif", "National Land Cover Database 2021")
    )
    path = written(tmp_path / name, codes, "uint8", tags={"title": title})
    source = load(dem, cover=str(path))
    np.testing.assert_array_equal(source.classes, expected(codes, "nlcd")[0])
    assert said(source.notes, "land cover: NLCD, known by its name or metadata")


def test_what_the_table_lacks_is_named_with_its_share_and_so_is_no_data(tmp_path: Path, dem: Path) -> None:
    codes = patches(list(TABLES["worldcover"].grounds))
    codes[:4], codes[4:10] = 77, 0
    cover = written(tmp_path / "cover.tif", codes, "uint8")
    source = load(dem, cover=str(cover), cover_codes="worldcover")
    assert said(source.notes, "codes 77 on 2.0% of the terrain are not in the table")
    assert said(source.notes, "no data on 3.0% of the terrain")
    assert (source.classes[:10] == TerrainClass.UNKNOWN).all()
    own = load(dem, cover=str(cover), cover_codes="worldcover", cover_classes={"77": "rock", "0": "lethal"})
    assert (own.classes[:4] == TerrainClass.ROCK).all()
    assert np.isinf(own.factor[4:10]).all()
    strange = written(tmp_path / "strange.tif", patches([3, 600, 601, 602]), "uint16")
    with pytest.raises(TerrainError, match=r"codes \(3, 600, 601, 602\) are those of no built-in table"):
        load(dem, cover=str(strange))
    with pytest.raises(TerrainError, match="holds real numbers; codes are whole"):
        load(dem, cover=str(written(tmp_path / "real.tif", codes + 0.5)))


def test_codes_of_ones_own_come_from_the_scenario_or_a_csv_file(tmp_path: Path, dem: Path) -> None:
    codes = patches([1, 2, 7008])
    cover = str(written(tmp_path / "cover.tif", codes, "int32"))
    table = tmp_path / "codes.csv"
    table.write_text("code;class;name\n1;forest;Beech\n2;lethal;Quarry\n7008;2.5;Marsh, wet\n", encoding="utf-8")
    own = {"1": "forest", "2": "lethal", "7008": 2.5}
    for keys in ({"cover_codes": str(table)}, {"cover_classes": own}):
        source = load(dem, cover=cover, **keys)
        np.testing.assert_array_equal(source.classes == TerrainClass.FOREST, codes == 1)
        np.testing.assert_array_equal(np.isinf(source.factor), codes == 2)
        np.testing.assert_array_equal(source.factor == 2.5, codes == 7008)
    assert read_cover_table(table).grounds[7008].name == "Marsh, wet"


def test_a_table_that_has_none_of_the_codes_is_no_table_of_this_map(tmp_path: Path, dem: Path) -> None:
    cover = str(written(tmp_path / "cover.tif", patches([3, 7, 9]), "uint8"))
    with pytest.raises(
        TerrainError, match=r"cover.tif: none of its codes on the terrain \(3, 7, 9\) is in the table"
    ):
        load(dem, cover=cover, cover_codes="worldcover")
    with pytest.raises(TerrainError, match="nor a CSV file; did you mean 'worldcover'"):
        load(dem, cover=cover, cover_codes="worldcovr")
    one = load(dem, cover=cover, cover_codes="worldcover", cover_classes={"9": "rock"})
    assert said(one.notes, "codes 3, 7 on")


@pytest.mark.parametrize("line", ["7;1,7;Moor", "7,1.7,Moor", "7\t1,7\tMoor", '7;"1,7";"Moor"'])
def test_a_pace_is_read_as_it_is_written_whatever_parts_the_cells(tmp_path: Path, line: str) -> None:
    (tmp_path / "codes.csv").write_text(f"{line}\n", encoding="utf-8")
    ground = read_cover_table(tmp_path / "codes.csv").grounds[7]
    assert (ground.factor, ground.name) == (1.7, "Moor")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("1,forest\n1,rock", "line 2: code 1 comes twice"),
        ("1,sea", "line 1: 'sea' is no ground; expected unknown, water"),
        ("1,-2", "line 1: '-2' is no ground"),
        ("1,nan", "line 1: 'nan' is no ground"),
        ("1", "line 1: '' is no ground"),
        ("1O,forest\n2,rock", "line 1: '1O' is no code"),
        ("code,class\nx,rock", "line 2: 'x' is no code"),
        ("70000,rock", "'70000' is no code; expected a whole number to 65533"),
        ("code,class\n", "has no line of code and class"),
    ],
)
def test_a_bad_table_is_refused_with_its_line(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "codes.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(TerrainError, match=sentence) as refused:
        read_cover_table(path)
    assert "\n" not in str(refused.value)


# --- onto the grid ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("system", "step"), [(EUROPE, 20.0), (EUROPE, 7.0), (EUROPE, 90.0), ("EPSG:4326", 20.0)])
def test_no_code_is_made_up_by_resampling(tmp_path: Path, system: str, step: float) -> None:
    codes = patches([10, 50, 95, 100])
    place = PLACE if system == EUROPE else from_origin(9.0, 45.155, 0.0003, 0.0003)
    cover = written(tmp_path / "cover.tif", codes, "uint8", crs=system, transform=place)
    grid = GridSpec(int(3000 / step), int(3000 / step), step, 500_200, 4_999_800, EUROPE)
    found = read_cover(cover, grid, TerrainConfig(cover_codes="worldcover"))
    grounds = TABLES["worldcover"].grounds.values()
    allowed = {(int(ground.kind), float(np.float32(ground.factor))) for ground in grounds}
    pairs = set(zip(found.classes[found.known].tolist(), found.factor[found.known].tolist(), strict=True))
    assert len(pairs) == 4
    assert pairs <= allowed
    if (system, step) == (EUROPE, 20.0):
        np.testing.assert_array_equal(found.classes, expected(codes[10:160, 10:160], "worldcover")[0])
    if step == 90.0:
        assert said(found.notes, "each cell takes the most frequent code")


def test_what_lies_beside_the_map_or_under_its_mask_is_unknown(tmp_path: Path, dem: Path) -> None:
    codes = patches([10, 30, 50, 60, 80], seed=3)
    place = from_origin(502_000, 5_000_000, 20, 20)
    mask = np.full((SIDE, SIDE), 255, np.uint8)
    mask[:50] = 0
    path = written(tmp_path / "cover.tif", codes, "uint8", transform=place, mask=mask)
    cover = read_cover(path, load(dem).grid, TerrainConfig(cover_codes="worldcover"))
    assert not cover.known[:, :100].any()
    assert not cover.known[:50].any()
    assert cover.known[50:, 100:].all()
    np.testing.assert_array_equal(cover.classes[50:, 100:], expected(codes[50:, :100], "worldcover")[0])
    assert said(cover.notes, "frame covers 50.0% of the terrain")
    assert said(cover.notes, "no data on 62.5%")
    far = written(tmp_path / "far.tif", codes, "uint8", transform=from_origin(900_000, 5_000_000, 20, 20))
    with pytest.raises(TerrainError, match="does not overlap the terrain"):
        read_cover(far, load(dem).grid, TerrainConfig(cover_codes="worldcover"))
    moon = written(tmp_path / "moon.tif", codes, "uint8", crs="+proj=longlat +R=1737400 +no_defs")
    with pytest.raises(TerrainError, match="from which no way leads to EPSG:32632"):
        read_cover(moon, load(dem).grid, TerrainConfig(cover_codes="worldcover"))


def test_land_cover_wins_over_level_ground_and_says_so(tmp_path: Path) -> None:
    ground = np.maximum(hills(13, 900) - 300, 0).astype(np.float32)
    dem = written(tmp_path / "dem.tif", ground)
    sea = load(dem).classes == TerrainClass.WATER
    assert sea.any()
    codes = np.where(sea, 80, 30)
    codes[:, 100:] = 30
    source = load(dem, cover=str(written(tmp_path / "c.tif", codes, "uint8")), cover_codes="worldcover")
    np.testing.assert_array_equal(source.classes == TerrainClass.WATER, codes == 80)
    assert said(source.notes, f"{sea[:, 100:].sum() / sea.size:.1%} of the terrain is water by photo or heights")


def test_an_image_is_refused_as_land_cover_and_not_read_as_a_photo(tmp_path: Path, dem: Path) -> None:
    path = written(tmp_path / "drawn.tif", np.stack([patches([11, 131, 242])] * 3), "uint8")
    with pytest.raises(TerrainError, match=r"3 bands, expected one of codes; an image of a map .* terrain\.photo"):
        load(dem, cover=str(path))
    notes = load(dem, photo=str(path)).notes
    assert said(notes, "no classes are read from it")
    assert said(notes, "terrain.cover")


# --- a land-cover map as the terrain ------------------------------------------------------------------------


def test_a_map_of_codes_alone_is_level_ground_with_classes(tmp_path: Path) -> None:
    codes = patches(list(TABLES["worldcover"].grounds))
    path = written(tmp_path / "a.tif", codes, "uint8")
    with pytest.raises(TerrainError, match=r"'worldcover' if it is land cover, .* = 'metres' if heights"):
        load(path)
    assert load(path, elevation_encoding="metres").elevation_m.max() == 100
    tagged = written(tmp_path / "b.tif", codes, "uint8", tags={"product": "ESA WorldCover 10m"})
    for source in (load(path, cover_codes="worldcover"), load(tagged)):
        np.testing.assert_array_equal(source.classes, expected(codes, "worldcover")[0])
        assert (source.elevation_m == 0).all()
        assert said(source.notes, "there are no heights")


def test_heights_in_whole_metres_are_heights(tmp_path: Path) -> None:
    for name, heights in (("low", np.rint(hills(1, 43) + 1)), ("tens", np.rint(hills(1, 20)) * 10)):
        path = written(tmp_path / f"{name}.tif", heights, "uint8")
        np.testing.assert_array_equal(load(path).elevation_m, heights.astype(np.float32))
    for middle in (np.nan, 10.0):  # the part that is looked at first has no heights, or a lake's
        heights = hills(1, 300)
        heights[20:-20, 20:-20] = middle
        path = written(tmp_path / "real.tif", heights)
        np.testing.assert_array_equal(load(path).elevation_m, heights)


def test_a_palette_of_unknown_codes_is_asked_for(tmp_path: Path) -> None:
    colours = {n: (n, 255 - n, 77, 255) for n in range(256)}
    path = written(tmp_path / "a.tif", patches([1, 2, 3, 200]), "uint8", colours=colours)
    with pytest.raises(TerrainError, match=r"has a palette, and its codes \(1, 2, 3, 200\).*'metres' if heights"):
        load(path)
    assert load(path, elevation_encoding="metres").elevation_m.max() == 200
