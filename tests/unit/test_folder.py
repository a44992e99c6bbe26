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

from vipetsc.io import lock
from vipetsc.io.atomic import atomic_write
from vipetsc.io.folder import Claim, FolderError, claimed
from vipetsc.io.kinds import BRANCHES, KINDS, PAPER, RUN, SEARCH, SWEEP
from vipetsc.io.lock import locked

ROOT = Path(__file__).parents[2]
# A file by which the kind of a folder is recognised.
SHOWN = {RUN: "run.h5", BRANCHES: "branch-x.h5", SEARCH: "design.h5", SWEEP: "ensemble.h5", PAPER: "plan.json"}
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


def test_nothing_but_results_of_the_same_kind_is_replaced(tmp_path):
    """``--force`` replaces neither a file nor a folder of another kind or without a marker."""
    (tmp_path / "file").touch()
    assert_refused("is a file", tmp_path / "file", RUN, OLD, force=True)
    assert_refused("choose another --out", tmp_path, RUN, OLD, force=True)

    for kind, file in SHOWN.items():
        folder = tmp_path / kind.noun
        with claim(folder, kind, OLD):
            (folder / file).touch()
        for other in KINDS:
            if other is not kind:
                assert_refused("choose another --out", folder, other, OLD, force=True)
        assert names_in(folder) == {kind.marker, file}


def test_the_same_case_is_resumed_and_nothing_is_touched(run):
    """A claim with the case of the folder goes on with its results and does not write its case file again."""
    # The time of the last change would differ if the file were written again with the same bytes.
    before = (run / "case.toml").stat()
    for resume in (False, True):
        with claim(run, RUN, OLD, resume=resume) as work:
            assert work.going_on
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


def test_the_folder_in_which_one_works_is_replaced_too(run, monkeypatch):
    """The folder may be named "." or by a link: the earlier results are then beside the folder itself."""
    link = run.with_name("link")
    link.symlink_to(run)
    monkeypatch.chdir(run)
    for name in (".", link):
        with claim(name, RUN, NEW, force=True) as work:
            assert (run.with_name("run.old") / "case.toml").exists()
            work.publish()
    assert (run / "case.toml").read_text() == NEW


def test_folders_in_the_folder_of_a_sweep_are_its_members(tmp_path):
    folder = tmp_path / "sweep"
    with claim(folder, SWEEP, OLD):
        (folder / "ensemble.h5").touch()
        (folder / "000-amplitude").mkdir()
    with claim(folder, SWEEP, OLD, force=True):
        assert names_in(folder) == {"case.toml", ".lock"}


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
    for name in (".ensemble.h5.host-7-ab.part", "member/.analysis.h5.host-7-cd.part", "member/.lock"):
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


@pytest.mark.parametrize(
    ("path", "reason"),
    [("/proc/vipetsc", "No such file"), ("/dev/null/new", "Not a directory"), ("/proc/self/fd/new/er", "No such file")],
)
def test_a_folder_that_cannot_be_created_is_refused(path, reason):
    """The system's reason is given, after a limited number of attempts."""
    refused = pytest.raises(FolderError, match=f"{path}: cannot be created or locked: {reason}")
    with refused, locked(MPI.COMM_SELF, Path(path)):
        pass


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
