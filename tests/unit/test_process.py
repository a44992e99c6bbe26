"""A process before MPI: requests to stop."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from vipetsc.process import RANKS

pytestmark = pytest.mark.parallel(1)


# The process sends itself the signal; if the handler returned, the exit code would be 0.
REQUESTED = """
import os, signal
from vipetsc.process import end_on_request
end_on_request()
os.kill(os.getpid(), signal.{name})
"""


@pytest.mark.parametrize(
    ("launched", "said"), [({}, "vipetsc: stopped on request\n"), ({"OMPI_COMM_WORLD_RANK": "1"}, "")]
)
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_request_before_anything_has_begun_ends_the_process_with_code_75(name, launched, said):
    """A signal before any work ends the process with code 75, as a run that can be resumed; ranks print nothing."""
    # The tests may run under nohup, which ignores SIGHUP.
    not_ignored = f"import signal; signal.signal(signal.{name}, signal.SIG_DFL)"
    # Workers of pytest-xdist inherit what MPI has set in the process that started them.
    alone = {key: value for key, value in os.environ.items() if key not in RANKS}
    ended = subprocess.run(
        [sys.executable, "-c", not_ignored + REQUESTED.format(name=name)],
        env=alone | launched,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
    )

    assert ended.returncode == os.EX_TEMPFAIL == 75
    assert ended.stderr == said


def test_a_signal_that_nohup_has_set_aside_stays_so():
    """A process that ignores SIGHUP from its start, as under nohup, is not ended by it."""
    ignoring = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    program = ignoring + REQUESTED.format(name="SIGHUP")
    ended = subprocess.run([sys.executable, "-c", program], check=False)
    assert ended.returncode == 0
