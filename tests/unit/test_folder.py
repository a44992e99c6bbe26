"""Output folders: claims that begin, resume, replace or refuse them, also after kills; locks between processes."""

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from mpi4py import MPI

import pytest

from vipetsc.io.atomic import atomic_write
from vipetsc.io.folder import Claim, FolderError, claimed
from vipetsc.io.kinds import KINDS, PAPER, RUN
from vipetsc.io.lock import locked

# The case of the results in a folder, and the case of a later command.
OLD = "a = 1\n"
NEW = "a = 2\n"


def claim(*arguments, **options) -> AbstractContextManager[Claim]:
    return claimed(MPI.COMM_SELF, *arguments, **options)


def assert_refused(match: str, *arguments, **options) -> None:
    """Assert that a claim with these arguments is refused with a message."""
    with pytest.raises(FolderError, match=match), claim(*arguments, **options):
        pass


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def run(tmp_path):
    """Return a folder with a run of the case OLD, its analysis, and a file of the user's."""
    folder = tmp_path / "run"
    with claim(folder, RUN, OLD):
        for name in ("run.h5", "summary.json", "analysis.h5", "notes.txt"):
            (folder / name).write_text("old")

        (folder / "figures").mkdir()
        (folder / "figures" / "ledger.png").touch()
    return folder


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.noun)
def test_a_new_folder_gets_its_marker(tmp_path, kind):
    folder = tmp_path / "deep" / "new"
    with claim(folder, kind, OLD) as work:
        assert not work.going_on
    # The lock is removed with the claim.
    assert names_in(folder) == {kind.marker}
    assert (folder / kind.marker).read_text() == OLD


def test_force_sets_the_earlier_results_aside_until_the_new_ones_are_complete(run, caplog):
    """Earlier results wait in NAME.old, which a line names; files of the user stay where they are."""
    old = run.with_name("run.old")
    with caplog.at_level(logging.INFO, logger="vipetsc"), claim(run, RUN, NEW, force=True) as work:
        assert not work.going_on
        assert names_in(run) == {"case.toml", "notes.txt", ".lock"}
        assert names_in(old) == {"case.toml", "run.h5", "summary.json", "analysis.h5", "figures", ".replaced"}
        assert (old / "case.toml").read_text() == OLD
        (run / "run.h5").write_text("new")
        work.publish()
    assert str(old) in caplog.text

    assert names_in(run) == {"case.toml", "run.h5", "notes.txt"}
    assert (run / "case.toml").read_text() == NEW
    assert not old.exists()


def test_new_results_that_were_begun_are_resumed(run):
    """Without ``--force`` the new results go on, those of another case are refused with the place of the old ones."""
    old = run.with_name("run.old")
    with claim(run, RUN, NEW, force=True):
        (run / "parts").mkdir()
    assert_refused(f"the results that it was to replace are in {old}", run, RUN, OLD)

    with claim(run, RUN, NEW, resume=True) as work:
        assert work.going_on
        assert (run / "parts").exists()
        assert (old / "run.h5").read_text() == "old"
        work.publish()
    assert not old.exists()


def test_force_once_more_drops_what_was_begun_and_keeps_what_was_complete(run):
    with claim(run, RUN, NEW, force=True):
        (run / "run.h5").write_text("begun")
        (run / "figures").mkdir()
    with claim(run, RUN, NEW, force=True):
        assert names_in(run) == {"case.toml", "notes.txt", ".lock"}
    assert (run.with_name("run.old") / "run.h5").read_text() == "old"


def test_force_goes_on_with_results_that_it_was_killed_in_moving(run):
    """A kill leaves a part of the results in NAME.old; the next ``--force`` moves the others there."""
    old = run.with_name("run.old")
    old.mkdir()
    (old / ".replaced").touch()
    (run / "figures").rename(old / "figures")
    with claim(run, RUN, NEW, force=True):
        assert names_in(old) == {"case.toml", "run.h5", "summary.json", "analysis.h5", "figures", ".replaced"}


@pytest.mark.parametrize("is_a_file", [False, True])
def test_a_folder_of_the_user_with_that_name_is_not_touched(run, is_a_file):
    backup = run.with_name("run.old")
    if is_a_file:
        backup.touch()
    else:
        shutil.copytree(run, backup)
    assert_refused("is in the way", run, RUN, NEW, force=True)
    assert (run / "run.h5").read_text() == "old"

    with claim(run, RUN, OLD) as work:
        work.publish()
    assert backup.exists()


def test_files_that_a_killed_command_leaves_are_removed(tmp_path):
    for name in ("parts", "figures"):
        (tmp_path / name).mkdir()
    # Killed processes leave files with such names, on this host and on others.
    for name in (".lock", ".run.h5.part", ".run.h5.host-7-ab.part", "figures/.ledger.png.host-7-cd.part"):
        (tmp_path / name).touch()
    (tmp_path / ".parts.old").mkdir()
    (tmp_path / ".parts.old" / "part-000000-0.npy").touch()

    with claim(tmp_path, RUN, OLD) as work:
        assert not work.going_on
    assert names_in(tmp_path) == {"case.toml", "parts", "figures"}
    assert not names_in(tmp_path / "figures")


def test_a_file_that_another_command_writes_stays(tmp_path):
    """A claim keeps temporary files of a folder below, which another command has locked and may be writing."""
    with claim(tmp_path, PAPER, OLD):
        pass

    with locked(MPI.COMM_SELF, tmp_path / "step"), atomic_write(tmp_path / "step" / "a") as temporary:
        temporary.touch()
        with claim(tmp_path, PAPER, OLD):
            assert temporary.exists()


HOLDER = """
import sys
from pathlib import Path
from mpi4py import MPI
from vipetsc.io.lock import locked
with locked(MPI.COMM_SELF, Path(sys.argv[1])):
    print("here", flush=True)
    sys.stdin.read()
"""


@contextmanager
def held(folder: Path) -> Iterator[subprocess.Popen]:
    """Let another process work in the folder until the block ends, or its standard input is closed."""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdin=pipe, stdout=pipe) as process:
        try:
            # The process prints when it has the lock.
            process.stdout.readline()
            yield process
        finally:
            process.kill()


def written_at(folder: Path) -> dict[Path, int]:
    """Return the time in ns of the last change of each file and folder; a file that comes and goes changes a folder."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.parametrize("command", [("run", "--force", "--set", "time.end=0.1"), ("paper", "--quick")])
def test_a_folder_that_another_process_works_in_is_left_alone(run, in_process, command):
    """Every verb refuses a folder that another process has locked and names it; locks of killed processes are free."""
    with held(run) as process:
        before = written_at(run)
        ended = in_process(*command, "--out", run)
        assert ended.returncode == 2
        assert f"process {process.pid} on {os.uname().nodename} is working in it" in ended.stderr
        assert written_at(run) == before

        process.kill()
        process.wait()
        assert (run / ".lock").exists()
        with claim(run, RUN, OLD):
            pass
        assert not (run / ".lock").exists()


@pytest.mark.parametrize(
    ("path", "reason"),
    [("/proc/vipetsc", "No such file"), ("/dev/null/new", "Not a directory"), ("/proc/self/fd/new/er", "No such file")],
)
def test_a_folder_that_cannot_be_created_is_refused(path, reason):
    """The system's reason is given, after a limited number of attempts."""
    refused = pytest.raises(FolderError, match=f"{path}: cannot be created or locked: {reason}")
    with refused, locked(MPI.COMM_SELF, Path(path)):
        pass
