"""How wide a window a move asks for: a schedule of doubling widths; the paper's variable range, mended."""

from __future__ import annotations

from swarm.grid import GridSpec

AHEAD = 16
"""A window reaches so many times as far as the target has come since one so wide was grown last."""


class WindowSchedule:
    """Windows of doubling width, each of which is due once the target has come a share of that width.

    Routes are as old as the widest window that they begin in. What the target has moved since matters in proportion
    to how far away it is: a window that reaches `AHEAD` times as far keeps that small at every distance, and costs
    64 cells of growth per cell of its width and move.

    half  of the narrowest window, cells to every side; one that narrow is grown with every move
    """

    def __init__(self, grid: GridSpec, half: int) -> None:
        self._grid = grid
        self._half = half
        # Where the target stood when the whole tree was last grown, and when each width was: narrowest first.
        self._whole = 0
        self._centres = [0] * max((max(grid.rows, grid.cols) // half).bit_length(), 1)

    def half(self, cell: int, widest: int) -> int:
        """How far the window around a target that came to `cell` should reach, at most `widest` unless the
        narrowest is wider. No window is ever narrower than the way since one so wide, so that windows overlap."""
        found = self._half
        for doublings, centre in enumerate(self._centres):
            half = self._half << doublings
            if half > max(widest, self._half):
                break
            if AHEAD * self._grid.distance_cells(centre, cell) >= half:
                found = half
        return found

    def beyond(self, cell: int, widest: int) -> bool:
        """Whether what lies beyond a window of `widest` cells is due to be renewed: when a window twice as wide
        would be."""
        return AHEAD * self._grid.distance_cells(self._whole, cell) >= 2 * widest

    def note_grown(self, cell: int, half: int) -> None:
        """A window of `half` cells to every side of `cell` was grown: all widths up to it begin anew."""
        if half >= max(self._grid.rows, self._grid.cols):
            self._whole = cell
        for doublings in range(len(self._centres)):
            if self._half << doublings <= half:
                self._centres[doublings] = cell


def block_half(grid: GridSpec, old: int, new: int, k_min: int) -> int:
    """How far, in cells, the window of variable range reaches to every side (section 3.3.2).

    With the largest k >= k_min of which the target crossed the border of a block of 2**k cells the window is
    2**(k+2) + 1 cells wide, without any 2**(k_min+1) + 1 as in figure 3: 9 cells with k_min = 2. The printed rule
    asks that row and column cross at once, which a move along an axis never does; here either is enough. At least
    twice as far as the move was long, so that the window holds both cells and some room around them.
    """
    row, col = grid.row_col(new)
    old_row, old_col = grid.row_col(old)
    # Of numbers that differ, the highest bit in which they do is the largest block whose border was crossed.
    k = ((row ^ old_row) | (col ^ old_col)).bit_length() - 1
    half = 2 << k if k >= k_min else 1 << k_min
    return max(half, 2 * grid.distance_cells(old, new))


def exact_half(grid: GridSpec, old: int, new: int) -> int:
    """How far, in cells, the window of an exact move reaches to every side.

    Near the root the ways of whole trunks change, which a window finds at the cost of a growth, a cell of it; what
    it does not find costs several times as much a cell, but nobody's exactness. Measured on four elevation models
    and made-up terrain of 512 to 2048 cells a side.
    """
    side = min(grid.rows, grid.cols)
    return max(16, min(side // 12, 64), 2 * grid.distance_cells(old, new))
