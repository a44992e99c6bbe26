"""Requests to stop while the program is loading, and those that a launcher sends because a rank was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from tests.conftest import clean_environment

# A module that takes 100 s to load.
ENDLESS = "import sys, time\nprint('loading', flush=True)\ntime.sleep(100)\n"
RANK_1_IS_KILLED = """
import os, signal, sys
from dataclasses import replace
from vipetsc import __main__ as front_door
from vipetsc.cli.verbs.verb_list import VERBS
from vipetsc.parallel import StoppedError

def stop(options, comm, request):
    if comm.rank == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    raise StoppedError("stopped on request")

VERBS["doctor"] = replace(VERBS["doctor"], function=stop, is_stoppable=True)
sys.exit(front_door.main(["doctor"]))
"""


def test_a_request_while_modules_load_is_one(tmp_path):
    """A signal during the import of petsc4py ends the program with exit code 75 and a sentence, without a traceback."""
    package = tmp_path / "petsc4py"
    package.mkdir()
    (package / "__init__.py").write_text(ENDLESS)
    path = os.pathsep.join([str(tmp_path), *sys.path])
    environment = clean_environment() | {"PYTHONPATH": path}
    command = [sys.executable, "-m", "vipetsc", "doctor"]

    def listen() -> None:
        # A shell that starts the tests in the background may have made them ignore signals.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=listen
    ) as process:
        try:
            assert process.stdout.readline() == "loading\n"
            process.send_signal(signal.SIGTERM)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()

    assert process.returncode == 75
    assert errors == "vipetsc: stopped on request\n"


@pytest.mark.mpirun
def test_nobody_stops_on_request_where_a_rank_was_killed(tmp_path):
    """After a rank was killed the job has the exit code of the kill, and no rank reports a stop on request."""
    script = tmp_path / "killed.py"
    script.write_text(RANK_1_IS_KILLED)
    command = ["mpirun", "--oversubscribe", "-n", "2", sys.executable, str(script)]
    ended = subprocess.run(command, capture_output=True, text=True, env=clean_environment(), timeout=100, check=False)
    assert "stopped on request" not in ended.stderr
    assert ended.returncode == 128 + signal.SIGKILL
