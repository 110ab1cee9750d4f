"""Where vehicles may start: found once for all agents of a machine."""

from __future__ import annotations

import numpy as np

from shared_map.arrays import Bools, Floats


def homes_of(prior: Floats, truth: Floats) -> Bools:
    """The largest connected part that can be driven by the map and in truth, bool (rows, cols).

    prior, truth  float32 (rows, cols), s/m; inf is lethal
    """
    return largest_part(np.isfinite(prior) & np.isfinite(truth))


def largest_part(passable: Bools) -> Bools:
    """The largest connected part of the cells that can be driven, bool (rows, cols); none if there are none.

    A diagonal step has passable cells beside it, so what is connected by eight-neighbour steps is exactly what is
    connected by four-neighbour steps.
    """
    # Imported here: it takes half a second, and no process of a run needs it where the terrain is prepared.
    from scipy import ndimage

    labels, count = ndimage.label(passable)
    if count == 0:
        return passable
    part: Bools = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    return part
