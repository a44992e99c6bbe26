"""Requests to stop: which signals are one, what a second does, what is put back."""

import signal

import pytest

from vipetsc.parallel import STOP_SIGNALS, StoppedError, StopRequest


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_is_a_request_and_a_second_one_the_end(number):
    before = {other: signal.getsignal(other) for other in STOP_SIGNALS}
    with StopRequest().listening() as stop:
        assert not stop.requested
        signal.raise_signal(number)
        assert stop.requested
        assert {signal.getsignal(other) for other in STOP_SIGNALS} == {signal.SIG_DFL}
    assert {other: signal.getsignal(other) for other in STOP_SIGNALS} == before


def test_what_has_nothing_to_save_ends_at_once():
    with pytest.raises(StoppedError), StopRequest().listening(at_once=True):
        signal.raise_signal(signal.SIGUSR1)


def test_a_signal_that_nohup_ignores_stays_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopRequest().listening() as stop:
            signal.raise_signal(signal.SIGHUP)
            assert not stop.requested
    finally:
        signal.signal(signal.SIGHUP, before)
