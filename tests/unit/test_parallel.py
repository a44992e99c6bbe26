"""Requests to stop: signals that count as one, a second signal, handlers that are restored, work that ends at once."""

import signal
import subprocess
import sys

from mpi4py import MPI

import pytest

from tests.conftest import clean_environment
from vipetsc.parallel import STOP_SIGNALS, EndedError, StopRequest, on_every_rank, on_root


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


@pytest.mark.slow
def test_a_signal_that_is_sent_twice_is_one_request():
    """``timeout`` sends its signal twice: a repeat within 30 ms does not end a program that saves its state."""
    with subprocess.Popen([sys.executable, "-c", SAVES], stdout=subprocess.PIPE, text=True) as process:
        number = process.stdout.readline().strip()
        subprocess.run(["sh", "-c", f"kill -TERM {number}; sleep 0.03; kill -TERM {number}"], check=True)

        assert process.stdout.read() == "saved\n"
    assert process.returncode == 0


def test_what_has_nothing_to_save_ends_at_once():
    """A signal raises EndedError in work that has nothing to save; handlers of errors do not catch it."""
    with StopRequest().listening() as stop, pytest.raises(EndedError), stop.at_once():
        signal.raise_signal(signal.SIGUSR1)
        pytest.fail("the work went on")


def test_what_has_nothing_to_save_does_not_begin_after_a_request():
    """Work that has nothing to save ends before it begins if a stop was requested before."""
    with StopRequest().listening() as stop:
        signal.raise_signal(signal.SIGUSR1)
        with pytest.raises(EndedError), stop.at_once():
            pytest.fail("the work began")


def test_an_error_that_the_end_of_such_work_causes_is_not_reported():
    """EndedError is raised although a cleanup that it causes, as in a library, raises an error in its place."""
    with StopRequest().listening() as stop, pytest.raises(EndedError), stop.at_once():
        try:
            signal.raise_signal(signal.SIGUSR1)
        finally:
            raise KeyError(0)


@pytest.mark.parametrize("agree", [on_root, on_every_rank])
def test_an_error_that_the_end_of_such_work_causes_is_no_error_of_all_ranks(agree):
    """An error in a cleanup after EndedError is not raised on all ranks, since other ranks go on."""

    def work() -> None:
        try:
            raise EndedError
        finally:
            raise KeyError(0)

    with pytest.raises(EndedError):
        agree(MPI.COMM_SELF, work)


# The first signal comes in a destructor, where Python swallows exceptions; the work goes on after it.
ENDS_IN_A_DESTRUCTOR = """
import signal, sys, time, vipetsc.parallel as p

class Handle:
    def __del__(self):
        signal.raise_signal(signal.SIGTERM)
        print("the destructor went on")

with p.StopRequest().listening() as stop, stop.at_once():
    handle = Handle()
    del handle
    time.sleep(30)
"""


@pytest.mark.slow
def test_a_signal_in_a_destructor_ends_such_work_without_a_trace():
    """A signal within a destructor, where Python swallows exceptions, ends the process within seconds, with code 75."""
    script = [sys.executable, "-c", ENDS_IN_A_DESTRUCTOR]
    ended = subprocess.run(script, capture_output=True, text=True, timeout=25, env=clean_environment(), check=False)

    assert (ended.returncode, ended.stdout) == (75, "")
    assert ended.stderr == "vipetsc: stopped on request\n"


def test_errors_of_such_work_are_reported_where_nobody_asked_to_stop():
    """Without a request an error within ``at_once`` is raised as it is."""
    with StopRequest().listening() as stop, pytest.raises(KeyError), stop.at_once():
        raise KeyError(0)


def test_such_work_goes_on_after_a_part_of_it_that_says_the_same():
    """After an inner ``at_once`` a signal still ends the work of the outer one."""
    with StopRequest().listening() as stop, pytest.raises(EndedError), stop.at_once():
        with stop.at_once():
            pass
        signal.raise_signal(signal.SIGUSR1)
        pytest.fail("the work went on")


def test_after_such_work_a_request_is_kept_again():
    """After ``at_once`` a signal is a request and raises nothing."""
    with StopRequest().listening() as stop:
        with stop.at_once():
            pass
        signal.raise_signal(signal.SIGUSR1)
        assert stop.requested


def test_a_signal_that_nohup_ignores_stays_ignored():
    """SIGHUP is no request to a process that was started to ignore it."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)

    with StopRequest().listening() as stop:
        signal.raise_signal(signal.SIGHUP)
        assert not stop.requested


def test_a_signal_while_handlers_are_replaced_is_a_request(monkeypatch):
    """A signal that comes after the first handler is replaced, and before the others are, is a request as any other."""
    replace = signal.signal

    def replace_and_signal(number, handler):
        before = replace(number, handler)
        monkeypatch.undo()
        signal.raise_signal(number)
        return before

    monkeypatch.setattr(signal, "signal", replace_and_signal)
    with StopRequest().listening() as stop:
        assert stop.requested
