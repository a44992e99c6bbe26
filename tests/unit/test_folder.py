"""Output folders: claims that begin, resume, replace or refuse them, also after kills; locks between processes."""

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from mpi4py import MPI

import pytest

from vipetsc.io import lock
from vipetsc.io.atomic import atomic_write
from vipetsc.io.folder import BRANCHES, KINDS, PAPER, RUN, SEARCH, SWEEP, Claim, FolderError, claimed
from vipetsc.io.lock import locked

ROOT = Path(__file__).parents[2]
# A file by which the kind of a folder is recognised.
SHOWN = {RUN: "run.h5", BRANCHES: "branch-x.h5", SEARCH: "design.h5", SWEEP: "index.json", PAPER: "plan.json"}
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
        assert work.folder == folder
    # The lock is removed with the claim.
    assert names_in(folder) == {kind.marker}
    assert (folder / kind.marker).read_text() == OLD


def test_nothing_but_results_of_the_same_kind_is_replaced(tmp_path):
    """``--force`` replaces neither a file nor a folder of another kind or without a marker."""
    (tmp_path / "file").touch()
    assert_refused("is a file", tmp_path / "file", RUN, OLD, force=True)
    assert_refused("of this kind", tmp_path, RUN, OLD, force=True)

    for kind, file in SHOWN.items():
        folder = tmp_path / kind.noun
        with claim(folder, kind, OLD):
            (folder / file).touch()
        for other in KINDS:
            if other is not kind:
                assert_refused("of this kind", folder, other, OLD, force=True)
        assert names_in(folder) == {kind.marker, file}


def test_the_same_case_is_resumed_and_nothing_is_touched(run):
    """A claim with the case of the folder goes on with its results and does not write its case file again."""
    # The time of the last change would differ if the file were written again with the same bytes.
    before = (run / "case.toml").stat()
    for resume in (False, True):
        with claim(run, RUN, OLD, resume=resume) as work:
            assert work.going_on
            assert work.folder == run
    assert (run / "case.toml").stat() == before


@pytest.mark.parametrize("resume", [False, True])
def test_another_case_is_refused_with_the_difference(run, resume):
    message = "contains another run: a = 1 there, 2 here; replace it with --force, or choose another folder with --out"
    assert_refused(message, run, RUN, NEW, resume=resume)


def test_a_folder_that_is_not_there_is_not_resumed(tmp_path):
    message = "contains no run to resume; omit --resume"
    assert_refused(message, tmp_path / "deep" / "none", RUN, OLD, resume=True)
    # The folder above it was not created either.
    assert not names_in(tmp_path)


def test_the_caller_decides_which_cases_differ(tmp_path):
    """A function of the caller says in which way an earlier case differs; if in none, the new text is written."""
    folder = tmp_path / "nnm"
    with claim(folder, BRANCHES, OLD):
        pass
    message = "another system: a = 1"
    assert_refused(message, folder, BRANCHES, NEW, difference=lambda earlier: f"another system: {earlier}")

    with claim(folder, BRANCHES, NEW, resume=True, difference=lambda earlier: None) as work:
        assert work.going_on
    assert (folder / "case.toml").read_text() == NEW


def replacing(folder: Path) -> Iterator[Claim]:
    """Make new results in a folder with old ones and yield the claim before they are published."""
    with claim(folder, RUN, NEW, force=True) as work:
        assert not work.going_on
        assert work.folder == folder / ".new"
        (work.folder / "run.h5").write_text("new")
        (work.folder / "figures").mkdir()
        yield work


def test_new_results_replace_the_old_ones_whole(run):
    for work in replacing(run):
        assert (run / "case.toml").read_text() == OLD
        assert (run / "run.h5").read_text() == "old"
        work.publish()
        assert work.folder == run

    # A file of the user's stays.
    assert names_in(run) == {"case.toml", "run.h5", "figures", "notes.txt"}
    assert (run / "case.toml").read_text() == NEW
    assert (run / "run.h5").read_text() == "new"
    assert not names_in(run / "figures")


class KilledError(Exception):
    """An exception that stands for a kill: no later step is done."""


def publish_and_be_killed(folder: Path, monkeypatch, renamings: int) -> bool:
    """Replace a folder's results, be killed after so many ``renamings``, and return whether there were more of them."""
    remaining = renamings

    def rename(source, target, replace=os.replace):
        nonlocal remaining
        remaining -= 1
        if remaining < 0:
            raise KilledError
        replace(source, target)

    with monkeypatch.context() as context:
        try:
            for work in replacing(folder):
                context.setattr(os, "replace", rename)
                work.publish()
        except KilledError:
            return True
    return False


def test_a_swap_killed_anywhere_is_finished_by_the_next_command(run, monkeypatch, tmp_path):
    """The next command finishes a swap of results that was killed before any of its renamings or its removal."""
    # A swap has fewer than twelve renamings: the last of these commands is not killed.
    for renamings in range(12):
        folder = tmp_path / f"killed-{renamings}"
        shutil.copytree(run, folder)
        killed = publish_and_be_killed(folder, monkeypatch, renamings)

        # The first renaming decides which results there are.
        case, content = (NEW, "new") if renamings else (OLD, "old")
        with claim(folder, RUN, case) as work:
            assert work.going_on
        assert (folder / "run.h5").read_text() == content
        if renamings:
            assert names_in(folder) == {"case.toml", "run.h5", "figures", "notes.txt"}, renamings
    # If the last command was killed, a swap has more renamings than were tried.
    assert not killed


def test_old_results_stay_while_new_ones_are_made(run):
    for _ in replacing(run):
        pass
    with claim(run, RUN, OLD) as work:
        assert work.folder == run


@pytest.mark.parametrize("resume", [False, True])
def test_new_results_that_were_begun_are_resumed(run, resume):
    for _ in replacing(run):
        pass
    with claim(run, RUN, NEW, resume=resume) as work:
        assert work.going_on
        assert work.folder == run / ".new"
        assert (work.folder / "run.h5").read_text() == "new"


def test_new_results_that_were_begun_are_dropped_by_force(run):
    for _ in replacing(run):
        pass
    with claim(run, RUN, NEW, force=True) as work:
        assert names_in(work.folder) == {"case.toml"}


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


def test_verbs_without_results_of_their_own_remove_such_files_too(tmp_path):
    """``analyse`` and ``plot`` lock a folder that they do not claim: leftovers go, also in the folders of members."""
    (tmp_path / "member").mkdir()
    for name in (".index.json.host-7-ab.part", "member/.analysis.h5.host-7-cd.part", "member/.lock"):
        (tmp_path / name).touch()
    with locked(MPI.COMM_SELF, tmp_path):
        assert names_in(tmp_path) == {".lock", "member"}
        assert not names_in(tmp_path / "member")


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


class Clock:
    """A clock in place of the module ``time``, whose sleeps take no time and call ``meanwhile`` with their number."""

    def __init__(self, meanwhile: Callable[[int], None] = lambda turn: None) -> None:
        self.meanwhile = meanwhile
        self.seconds = 0.0
        self.turns = 0

    def monotonic(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds
        self.turns += 1
        self.meanwhile(self.turns)


def written_at(folder: Path) -> dict[Path, int]:
    """Return the time in ns of the last change of each file and folder; a file that comes and goes changes a folder."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ("run",),
        ("run", "--force", "--set", "time.end=0.1"),
        ("run", "--resume"),
        ("sweep", ROOT / "runs/examples" / "scattering-amplitudes.toml"),
        ("nnm", ROOT / "runs/examples" / "nnm-cubic.toml"),
        ("design",),
        ("paper", "--quick"),
    ],
)
def test_a_folder_that_another_process_works_in_is_left_alone(run, in_process, command, monkeypatch):
    """Every verb refuses a folder that another process has locked and names it; locks of killed processes are free."""
    monkeypatch.setattr("vipetsc.io.lock.PATIENCE", 0.1)

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


@pytest.mark.parametrize("folder_is_new", [False, True])
def test_a_command_waits_for_a_process_that_is_ending(run, tmp_path, caplog, monkeypatch, folder_is_new):
    """A command waits some seconds for a lock and then takes it.

    After ``kill -9`` of a rank, mpirun returns while another rank, which has the lock, is still ending.
    """
    folder = tmp_path / "new" if folder_is_new else run
    with held(folder) as process, caplog.at_level(logging.INFO, logger="vipetsc"):
        # The holder ends while this process waits for the third time.
        def end_the_holder(turn):
            if turn == 3:
                process.stdin.close()
                process.wait()

        clock = Clock(meanwhile=end_the_holder)
        monkeypatch.setattr(lock, "time", clock)
        with locked(MPI.COMM_SELF, folder):
            assert (folder / ".lock").read_text().startswith(f"process {os.getpid()} ")
    assert clock.turns == 3

    # The other process created a new folder and removed it; this process created it again and removed it.
    assert folder.exists() != folder_is_new
    (message,) = caplog.messages
    assert f"{folder}: process {process.pid} on {os.uname().nodename} is working in it; waiting up to 5 s" in message


def test_a_folder_that_its_holder_removes_before_it_can_be_locked_is_created_again(tmp_path, monkeypatch):
    folder = tmp_path / "new"
    try_to_lock = lock._try_to_lock
    removed = []

    # The holder removes the folder after this process has found or created it and before this process locks it.
    def remove_once(path):
        if not removed:
            path.rmdir()
            removed.append(path)
        return try_to_lock(path)

    monkeypatch.setattr(lock, "_try_to_lock", remove_once)
    with locked(MPI.COMM_SELF, folder):
        assert (folder / ".lock").exists()
    assert removed == [folder]
    assert not folder.exists()


def test_a_folder_that_its_holder_removes_while_it_is_created_is_created_again(tmp_path, monkeypatch):
    """The folder is created again if it exists when ``mkdir`` is called and is gone when Python looks for it."""
    folder = tmp_path / "new"
    mkdir = os.mkdir
    refused = []

    def refuse_once(path, *arguments):
        if not refused:
            refused.append(path)
            raise FileExistsError(17, "File exists", str(path))
        mkdir(path, *arguments)

    monkeypatch.setattr(os, "mkdir", refuse_once)
    with locked(MPI.COMM_SELF, folder):
        assert (folder / ".lock").exists()
    assert refused == [folder]


def test_a_command_waits_only_as_long_as_announced_for_a_process_that_stays(run, caplog, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(lock, "time", clock)
    caplog.set_level(logging.INFO, logger="vipetsc")
    refused = pytest.raises(FolderError, match="is working in it; wait until it has ended")
    with held(run), refused, locked(MPI.COMM_SELF, run):
        pass
    # The command looks often and logs once.
    (message,) = caplog.messages
    assert "waiting up to 5 s" in message
    assert clock.turns >= 20
    # The command gives up at its first look after the time that it has announced.
    assert 5 <= clock.seconds < 5 + 2 * lock.LOOK_EVERY


@pytest.mark.parametrize("below", [".", "new"])
def test_a_link_to_a_folder_that_is_missing_is_refused(tmp_path, monkeypatch, below):
    """A link to a missing folder is refused after a few attempts, since no folder can be created there."""
    (tmp_path / "link").symlink_to(tmp_path / "missing")
    mkdir = os.mkdir
    tried = []

    def mkdir_a_few_times(path, *arguments):
        tried.append(path)
        assert len(tried) < 20
        mkdir(path, *arguments)

    monkeypatch.setattr(os, "mkdir", mkdir_a_few_times)
    refused = pytest.raises(FolderError, match=f"link is a link to {tmp_path}/missing, which is missing")
    with refused, locked(MPI.COMM_SELF, tmp_path / "link" / below):
        pass


def test_a_folder_that_cannot_be_locked_is_not_left_behind(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    # A file system without locks refuses so.
    monkeypatch.setattr("vipetsc.io.lock._acquire", refuse)
    with pytest.raises(PermissionError), locked(MPI.COMM_SELF, tmp_path / "a" / "b"):
        pass
    assert not any(tmp_path.iterdir())
