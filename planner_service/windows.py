"""How wide a window a move asks for: the paper's variable range, mended and as printed."""

from __future__ import annotations

from swarm.grid import GridSpec, Window


def block_window(grid: GridSpec, old: int, new: int, k_min: int) -> Window:
    """The paper's variable range: the largest k >= k_min whose block index of 2**k cells changed between two cells
    gives a window 2**(k+2)+1 wide; if none did, the one of k_min. At least as far out as the move was long, and
    shut around both cells."""
    row, col = grid.row_col(new)
    old_row, old_col = grid.row_col(old)
    # Of numbers that differ, the highest bit in which they do is the largest block that has changed.
    k = max(k_min, ((row ^ old_row) | (col ^ old_col)).bit_length() - 1)
    return grid.around(new, max(2 << k, 2 * grid.distance_cells(old, new)))


def literal_window(grid: GridSpec, old: int, new: int) -> Window:
    """The paper's rule as it is printed: a block must be crossed in row and column at once, so that it never widens
    for a move along an axis. For comparison only."""
    row, col = grid.row_col(new)
    old_row, old_col = grid.row_col(old)
    k = 1
    for exponent in range(1, max(grid.rows, grid.cols).bit_length() + 1):
        if row >> exponent != old_row >> exponent and col >> exponent != old_col >> exponent:
            k = exponent
    return grid.around(new, 2 << k)
