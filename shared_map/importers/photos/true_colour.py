"""Whether an image is a true-colour photo: rules that know what grass looks like know nothing of other images."""

from __future__ import annotations

import numpy as np

from shared_map.arrays import Bools, Bytes

MOST_SIDE = 1024
_DARK = 30
_LEGEND_COLOURS, _LEGEND_SAME = 64, 0.6
_RED_OVER_GREEN, _LIKE_BLUE, _FALSE_SHARE = 1.4, 0.15, 0.25


def why_not_true_colour(rgb: Bytes, seen: Bools) -> str | None:
    """What an image is instead of a true-colour photo, for people; None if it may be one.

    Parameters
    ----------
    rgb : uint8 (rows, cols, 3), red, green, blue
    seen : bool (rows, cols)
        Where it shows anything.

    Returns
    -------
    str or None
        A map with a legend has few colours, in areas. Where near infrared is shown as red, plants are red, with as
        much green as blue; the reds of true ground have more green than blue.
    """
    drawn = why_drawn(rgb, seen)
    if drawn is not None:
        return drawn
    stride = max(-(-max(seen.shape) // MOST_SIDE), 1)
    some, shown = rgb[::stride, ::stride].astype(np.int32), seen[::stride, ::stride]
    red, green, blue = some[..., 0], some[..., 1], some[..., 2]
    lit = shown & (red + green + blue > _DARK)
    false = (red > _RED_OVER_GREEN * green) & (np.abs(green - blue) < _LIKE_BLUE * red) & lit
    share = false.sum() / max(int(lit.sum()), 1)
    if share > _FALSE_SHARE:
        return f"in false colour: {share:.0%} of it is as red as plants are where near infrared is shown as red"
    return None


def why_drawn(rgb: Bytes, seen: Bools) -> str | None:
    """That an image is a drawn map, for people; None if it may be a photo. Arguments as of `why_not_true_colour`.

    Pixels must be the file's own, or copies of them: between two colours of a legend an interpolation makes others.
    """
    stride = max(-(-max(seen.shape) // MOST_SIDE), 1)
    rows, cols = min(seen.shape[0], MOST_SIDE), min(seen.shape[1], MOST_SIDE)
    middle = rgb[:rows, :cols] if stride == 1 else rgb[(len(rgb) - rows) // 2 :, (rgb.shape[1] - cols) // 2 :]
    middle = middle[:rows, :cols]
    same = (middle[1:, 1:] == middle[:-1, 1:]).all(axis=2) & (middle[1:, 1:] == middle[1:, :-1]).all(axis=2)
    some, shown = rgb[::stride, ::stride].astype(np.int32), seen[::stride, ::stride]
    colours = np.unique((some[..., 0] << 16 | some[..., 1] << 8 | some[..., 2])[shown]).size
    if 1 < colours <= _LEGEND_COLOURS and same.mean() > _LEGEND_SAME:
        return f"a drawn map: it has {colours} colours, in areas"
    return None
