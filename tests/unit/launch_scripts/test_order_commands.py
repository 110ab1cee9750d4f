"""Commands that give orders: what cannot be one is refused before anything is asked, in a sentence."""

from __future__ import annotations

import pytest
from support.command import Swarm


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("zone add --polygon 5", "--polygon is '5'; expected LAT,LON"),
        ("zone add --polygon 5,x", "--polygon is '5,x'; expected LAT,LON"),
        ("zone add --polygon 1,1;2,2", "expected LAT,LON"),
        ("zone add --polygon latlon:91.5,2", "no latitude (-90 to 90)"),
        ("zone add --polygon 1,1 --kind deadly", "--kind: 'deadly' is neither lethal, keep-in nor pace:X"),
        ("zone add --polygon 1,1 --kind pace:nan", "--kind: 'pace:nan' is neither"),
        ("zone add --polygon 1,1 --for tomorrow", "--for: 'tomorrow' is no time such as 90s"),
        ("zone add --polygon 1,1 --for 0s", "--for: '0s' is no time"),
        ("zone add --crs local", "--layer and --crs go with --file"),
        ("zone add --file nowhere.geojson", "cannot read zone nowhere.geojson: No such file or directory"),
        ("zone add --file nowhere.geojson --polygon 1,1", "give either --file or a polygon"),
        ("zone remove a/b", "the order is not possible: name 'a/b' is not"),
        ("target add x --at 5", "--at is '5'; expected LAT,LON"),
        ("target add x/y --at 5,5", "name 'x/y' is not"),
        ("vehicle stop a*", "name 'a*' is not"),
        ("unset groups.", "name is missing"),
        ("set time_scale", "Missing argument 'VALUE': Its new value"),
        ("set time_scale nan", "value: found nan, expected a number"),
        ("set time_scale 5 6", "Got unexpected extra argument"),
    ],
)
def test_what_is_no_order_is_refused_with_the_option(words: str, says: str, swarm: Swarm) -> None:
    code, out, err = swarm("order", *words.split())
    assert (code, out) == (2, "")
    assert says in err
    assert err.count("\n") == 1
