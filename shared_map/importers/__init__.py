"""Files become ground: elevation, photo and classes of the ground on one square metric grid, and zones on it.

`terrain_sources` is the door: a table tells which reader takes a file by its ending, and a raster of any other name
is known by how it begins. Guarantees of each reader:

1. No file takes more memory or time than its kind allows: sizes are looked at before anything is read.
2. No file reaches another one, or the network, but those that lie beside it and belong to it.
3. Any fault of a file is reported in one sentence with its name, the value found and the value expected.
4. Nothing is guessed. If a file may have several meanings, the error names the setting that decides.
5. Changes to the data are listed in `Source.notes`.

`gdal_rasters` opens and guards all rasters; those which GDAL does not read, or not as they are, become datasets
in memory: those of `grids_without_gdal`, which has maps without heights, too. `height_rasters` tells what a raster
holds; `georeference` says where it lies, and brings it onto the grid. `undo_resampling` finds the survey's cells in
a file that was made finer; `water_and_voids` finds water and voids in a file's own cells, before anything is
resampled. Land cover and photos are in `cover`, vector zones in `zones`; codes, colours and classes of ways are
data beside their readers.
"""

from swarm.errors import require

require(__name__, "rasterio")
