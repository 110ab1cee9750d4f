"""A command that runs until it is asked to end does so, even where the exception is lost."""

from __future__ import annotations

import signal
from contextlib import suppress

import pytest

from launch_scripts.stop_requests import stop_requests


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_request_is_known_though_a_library_swallows_the_exception(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_requests() as stopping:
        assert not stopping()
        with suppress(BaseException):
            signal.raise_signal(number)
        assert stopping()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before
