"""Columns of numbers: whatever way is taken to check one, the verdict is the same."""

import math
import re
from typing import Annotated

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm.wire.fields import Bounded, Column

LEAST, MOST = -2.5, 7.0


class Floats(Bounded, frozen=True):
    values: Annotated[bytes, Column("<f8", least=LEAST, most=MOST)]


class Unending(Bounded, frozen=True):
    values: Annotated[bytes, Column("<f4", least=0, most=math.inf)]


class Whole(Bounded, frozen=True):
    values: Annotated[bytes, Column("<i8", least=-3, most=9)]


EDGES = [LEAST, MOST, np.nextafter(LEAST, -9), np.nextafter(MOST, 9), 0.0, -0.0, math.inf, -math.inf, math.nan]
SOME = {
    Floats: ("<f8", st.sampled_from(EDGES) | st.floats()),
    Unending: ("<f4", st.sampled_from(EDGES) | st.floats(width=32)),
    Whole: ("<i8", st.integers(-6, 12) | st.integers(-(2**63), 2**63 - 1)),
}


def fault(struct: type[Bounded], data: bytes) -> str | None:
    try:
        struct(data)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize("struct", SOME)
@given(data=st.data())
def test_a_value_is_judged_alone_as_it_is_among_others(struct: type[Bounded], data: st.DataObject) -> None:
    dtype, values = SOME[struct]
    one = np.array([data.draw(values)], dtype).tobytes()
    assert fault(struct, one) == fault(struct, one * 2) == fault(struct, one * 2000)


@pytest.mark.parametrize("struct", SOME)
def test_a_part_of_a_value_is_no_column(struct: type[Bounded]) -> None:
    width = np.dtype(SOME[struct][0]).itemsize
    with pytest.raises(ValueError, match=re.escape(f"values has {width - 1} bytes, not a column of")):
        struct(b"\0" * (width - 1))
    assert msgspec.structs.asdict(struct(b"\0" * width)) == {"values": b"\0" * width}


def test_a_refusal_names_the_bounds_and_of_floats_that_nan_is_none() -> None:
    assert fault(Floats, np.array([100], "<f8").tobytes()) == (
        "values has 100.0, expected float64 of -2.5 ... 7, without NaN"
    )
    assert fault(Whole, np.array([100], "<i8").tobytes()) == "values has 100, expected int64 of -3 ... 9"
