"""Where vehicles may start: found once for all agents of a machine."""

from __future__ import annotations

import numpy as np

from shared_map.arrays import Bools, Floats


def homes_of(prior: Floats, truth: Floats) -> Bools:
    """The largest connected part that can be driven by the map and in truth, bool (rows, cols).

    prior, truth  float32 (rows, cols), s/m; inf is lethal
    """
    # Imported here: it takes a tenth of a second, and nothing else in a vehicle needs it.
    from scipy import ndimage

    passable = np.isfinite(prior) & np.isfinite(truth)
    labels, count = ndimage.label(passable)
    if count == 0:
        return passable
    part: Bools = labels == 1 + int(np.argmax(np.bincount(labels.ravel())[1:]))
    return part
