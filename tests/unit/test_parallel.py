"""Requests to stop: signals that count as one, a second signal, handlers that are restored, work that ends at once."""

import signal
import subprocess
import sys

import pytest

from tests.conftest import clean_environment
from vipetsc.parallel import STOP_SIGNALS, StopRequest


@pytest.fixture(autouse=True)
def as_in_a_terminal():
    """Give the signals their default actions, though tests may run under nohup or in the background of a script."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_is_a_request_and_a_second_one_the_end(number):
    """The first signal is a request and restores the default action, by which a second one ends the process."""
    before = {other: signal.getsignal(other) for other in STOP_SIGNALS}
    with StopRequest().listening() as stop:
        assert not stop.requested
        signal.raise_signal(number)
        assert stop.requested
        assert {signal.getsignal(other) for other in STOP_SIGNALS} == {signal.SIG_DFL}

    assert {other: signal.getsignal(other) for other in STOP_SIGNALS} == before


# A program that saves for a fifth of a second after a request to stop.
SAVES = """
import os, vipetsc.parallel as p
with p.StopRequest().listening() as stop:
    print(os.getpid(), flush=True)
    while not stop.requested:
        pass
    os.system('sleep 0.2')
    print('saved')
"""


def test_a_signal_that_is_sent_twice_is_one_request():
    """``timeout`` sends its signal twice: a repeat within 30 ms does not end a program that saves its state."""
    with subprocess.Popen([sys.executable, "-c", SAVES], stdout=subprocess.PIPE, text=True) as process:
        number = process.stdout.readline().strip()
        subprocess.run(["sh", "-c", f"kill -TERM {number}; sleep 0.03; kill -TERM {number}"], check=True)

        assert process.stdout.read() == "saved\n"
    assert process.returncode == 0


# The first signal comes in a destructor, where Python swallows exceptions.
ENDS_AT_ONCE = """
import signal, time, vipetsc.parallel as p

class Handle:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)
        print("the destructor went on")

with p.StopRequest().listening() as stop, stop.at_once():
    with stop.at_once():
        pass
    handle = Handle()
    del handle
    time.sleep(30)
"""


def test_what_has_nothing_to_save_ends_at_once():
    """A signal ends such work wherever it is, with code 75."""
    script = [sys.executable, "-c", ENDS_AT_ONCE]
    ended = subprocess.run(script, capture_output=True, text=True, timeout=25, env=clean_environment(), check=False)
    assert (ended.returncode, ended.stdout) == (75, "")
    assert ended.stderr == "vipetsc: stopped on request\n"


def test_a_signal_that_nohup_ignores_stays_ignored():
    """SIGHUP is no request to a process that was started to ignore it."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)

    with StopRequest().listening() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.requested
