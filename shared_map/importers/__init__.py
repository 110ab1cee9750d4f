"""Files become ground: elevation, photo and classes of the ground on one square metric grid, and zones on it.

`sources` is the door: a table tells which reader takes a file by its ending, and a raster of any other name is
known by how it begins. What each reader promises:

1. No file takes more memory or time than its kind allows: sizes are looked at before anything is read.
2. No file reaches another one, or the network, but those that lie beside it and belong to it.
3. Whatever is wrong with a file is said in one sentence with its name, what was found and what was expected.
4. Nothing is guessed. Where a file may mean several things, the error names the setting that answers.
5. What was done to the data is told in `Source.notes`.

A kind of file has one module: `rasters` with `encoded_heights`, `array_grids`, `xyz_grids`. `raster_files` opens
and guards all rasters; `georeference` says where they lie, and `onto_grid` brings them onto the grid.
`level_ground` finds water and voids in a file's own cells, before anything is resampled. What covers the ground is
in `cover`, what is drawn on it in `zones`; codes, colours and classes of ways are data beside their readers.
"""
