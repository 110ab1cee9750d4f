"""Straight segments between centres of cells, with crossings that are fractions: what they touch and cost."""

import itertools
import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]


def crossed(start: Cell, end: Cell) -> tuple[list[tuple[Cell, Fraction]], list[tuple[Cell, Cell]]]:
    """The cells that a segment between centres crosses with their share of it, and the exact corners that it
    passes, each as the two cells beside it."""
    steps = [end[k] - start[k] for k in (0, 1)]
    met: list[dict[Fraction, int]] = [
        {Fraction(2 * i + 1, 2 * abs(n)): k for i in range(abs(n))} for k, n in enumerate(steps)
    ]  # where it meets lines between rows, and between cols
    marks = sorted({Fraction(0), Fraction(1), *met[0], *met[1]})
    shares = []
    for early, late in itertools.pairwise(marks):
        middle = (early + late) / 2
        half = Fraction(1, 2)
        at = (math.floor(start[0] + steps[0] * middle + half), math.floor(start[1] + steps[1] * middle + half))
        shares.append((at, late - early))
    corners = []
    for t in met[0].keys() & met[1].keys():
        before, after = (
            next(cell for (cell, _), m in zip(shares, marks[1:], strict=True) if m == t),
            next(cell for (cell, _), m in zip(shares, marks, strict=False) if m == t),
        )
        corners.append(((before[0], after[1]), (after[0], before[1])))
    return shares, corners


def cost_s(pace: NDArray[np.float32], start: Cell, end: Cell, corner_cutting: bool = False) -> float:
    """The integral of the pace along a segment, where a cell is a metre; inf where it may not be driven."""
    shares, corners = crossed(start, end)
    touched = [cell for cell, _ in shares]
    if not corner_cutting:
        touched += [cell for pair in corners for cell in pair]
    if not all(np.isfinite(pace[cell]) for cell in touched):
        return math.inf
    exact = sum(Fraction(float(pace[cell])) * share for cell, share in shares)
    return float(exact) * math.dist(start, end)
