"""The two forms of a tree, and from one to the other: with a cost in every cell, and in pieces."""

from __future__ import annotations

from planner_service.tree.cost_grid import CostGrid
from planner_service.tree.cost_to_go import CostToGoTree
from planner_service.tree.partitioned_tree import PieceTree

AnyTree = CostToGoTree | PieceTree


def empty_tree(cost_grid: CostGrid, in_pieces: bool) -> AnyTree:
    """One that is to be grown."""
    return PieceTree(cost_grid) if in_pieces else CostToGoTree(cost_grid)


def in_pieces(tree: AnyTree) -> PieceTree:
    """The tree in pieces, which makes it exact; itself if it is."""
    if isinstance(tree, PieceTree):
        return tree
    pieces = PieceTree(tree.cost_grid)
    pieces.take(tree.root, tree.parent)
    return pieces


def in_cells(tree: AnyTree) -> CostToGoTree:
    """The tree with a cost in every cell; itself if it has them."""
    if isinstance(tree, CostToGoTree):
        return tree
    whole = CostToGoTree(tree.cost_grid)
    whole.take_parents(tree.root, tree.parent)
    whole.exact = tree.exact
    return whole
