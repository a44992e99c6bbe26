"""Claiming output folders: what may be begun, replaced, gone on with; whatever had happened in them before."""

import logging
import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path
from threading import Timer

from mpi4py import MPI

import pytest

from vipetsc.io import lock
from vipetsc.io.atomic import atomic_write
from vipetsc.io.folder import BRANCHES, KINDS, PAPER, RUN, SEARCH, SWEEP, FolderError, claimed
from vipetsc.io.lock import PATIENCE, locked

ROOT = Path(__file__).parents[2]
SHOWN = {RUN: "run.h5", BRANCHES: "branch-x.h5", SEARCH: "design.h5", SWEEP: "index.json", PAPER: "plan.json"}
OLD = "a = 1\n"
ANEW = "a = 2\n"


def claim(*arguments, **options):
    return claimed(MPI.COMM_SELF, *arguments, **options)


def visible(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def run(tmp_path):
    """A folder with a run of OLD and its analysis, and a file of the user's."""
    folder = tmp_path / "run"
    with claim(folder, RUN, OLD):
        for name in ("run.h5", "summary.json", "analysis.h5", "notes.txt"):
            (folder / name).write_text("old")
        (folder / "figures").mkdir()
        (folder / "figures" / "ledger.png").touch()
    return folder


def test_a_new_folder_gets_its_marker(tmp_path):
    for kind in KINDS:
        folder = tmp_path / "deep" / kind.noun
        with claim(folder, kind, OLD) as right:
            assert not right.going_on
            assert right.folder == folder
        assert visible(folder) == {kind.marker}
        assert (folder / kind.marker).read_text() == OLD


def test_nothing_but_results_of_the_same_kind_is_replaced(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(FolderError, match="is a file"), claim(tmp_path / "file", RUN, OLD, force=True):
        pass
    with pytest.raises(FolderError, match="of this kind"), claim(tmp_path, RUN, OLD, force=True):
        pass
    for kind, file in SHOWN.items():
        folder = tmp_path / kind.noun
        with claim(folder, kind, OLD):
            (folder / file).touch()
        for other in KINDS:
            if other is not kind:
                with pytest.raises(FolderError, match="of this kind"), claim(folder, other, OLD, force=True):
                    pass
        assert visible(folder) == {kind.marker, file}


def test_the_same_case_goes_on_and_another_is_refused(run):
    before = (run / "case.toml").stat()
    for resume in (False, True):
        with claim(run, RUN, OLD, resume=resume) as right:
            assert right.going_on
            assert right.folder == run
    assert (run / "case.toml").stat() == before  # going on touches nothing
    for resume in (False, True):
        message = "holds another run: a = 1 there, 2 here; --force replaces it, --out chooses another folder"
        with pytest.raises(FolderError, match=message), claim(run, RUN, ANEW, resume=resume):
            pass
    with pytest.raises(FolderError, match="holds no run to resume; leave out --resume"):
        claim(run.parent / "deep" / "none", RUN, OLD, resume=True).__enter__()
    assert visible(run.parent) == {"run"}


def test_what_may_differ_is_the_caller_s_to_say(tmp_path):
    with claim(tmp_path / "nnm", BRANCHES, OLD):
        pass
    with pytest.raises(FolderError, match="another system: a = 1"):
        claim(tmp_path / "nnm", BRANCHES, ANEW, difference=lambda earlier: f"another system: {earlier}").__enter__()
    with claim(tmp_path / "nnm", BRANCHES, ANEW, resume=True, difference=lambda earlier: None) as right:
        assert right.going_on
    assert (tmp_path / "nnm" / "case.toml").read_text() == ANEW


def begin_anew(folder):
    """Make new results beside the old ones, to the last but one step."""
    with claim(folder, RUN, ANEW, force=True) as right:
        assert not right.going_on
        assert right.folder == folder / ".new"
        (right.folder / "run.h5").write_text("new")
        (right.folder / "figures").mkdir()
        yield right


def test_new_results_replace_the_old_ones_whole(run):
    for right in begin_anew(run):
        assert (run / "case.toml").read_text() == OLD
        assert (run / "run.h5").read_text() == "old"
        right.publish()
        assert right.folder == run
    assert visible(run) == {"case.toml", "run.h5", "figures", "notes.txt"}
    assert (run / "case.toml").read_text() == ANEW
    assert (run / "run.h5").read_text() == "new"
    assert not visible(run / "figures")


class KilledError(Exception):
    """Stands for a kill: what comes after is not done."""


def test_a_swap_killed_anywhere_is_finished_by_the_next_command(run, monkeypatch, tmp_path):
    """The names change one by one: killed before each of them, before the removal, and not at all."""
    for count in range(12):
        folder = tmp_path / f"killed-{count}"
        subprocess.run(["cp", "-r", run, folder], check=True)
        left = count

        def rename(source, target, replace=os.replace):
            nonlocal left
            left -= 1
            if left < 0:
                raise KilledError
            replace(source, target)

        killed = False
        with monkeypatch.context() as context:
            try:
                for right in begin_anew(folder):
                    context.setattr(os, "replace", rename)
                    right.publish()
            except KilledError:
                killed = True
        text = OLD if count == 0 else ANEW  # the first renaming decides
        with claim(folder, RUN, text) as right:
            assert right.going_on
        assert (folder / "run.h5").read_text() == ("old" if count == 0 else "new")
        if count:
            assert visible(folder) == {"case.toml", "run.h5", "figures", "notes.txt"}, count
    assert not killed  # there are fewer steps than that


def test_what_was_begun_anew_is_gone_on_with_or_dropped(run):
    for _ in begin_anew(run):
        pass
    with claim(run, RUN, OLD) as right:  # the case of the old results: they are there
        assert right.folder == run
    for resume in (False, True):
        with claim(run, RUN, ANEW, resume=resume) as right:
            assert right.going_on
            assert right.folder == run / ".new"
            assert (right.folder / "run.h5").read_text() == "new"
    with claim(run, RUN, ANEW, force=True) as right:
        assert visible(right.folder) == {"case.toml"}


def test_what_a_killed_command_leaves_is_no_dead_end(tmp_path):
    for name in ("parts", "figures"):
        (tmp_path / name).mkdir()
    for name in (".lock", ".run.h5.part", ".run.h5.host-7-ab.part", "figures/.ledger.png.host-7-cd.part"):
        (tmp_path / name).touch()
    (tmp_path / ".parts.old").mkdir()
    (tmp_path / ".parts.old" / "part-000000-0.npy").touch()
    with claim(tmp_path, RUN, OLD) as right:
        assert not right.going_on
    assert visible(tmp_path) == {"case.toml", "parts", "figures"}
    assert not visible(tmp_path / "figures")


def test_a_file_that_another_command_writes_stays(tmp_path):
    """A sweep below a paper's folder has a lock of its own."""
    with claim(tmp_path, PAPER, OLD):
        pass
    with locked(MPI.COMM_SELF, tmp_path / "step"), atomic_write(tmp_path / "step" / "a") as aside:
        aside.touch()
        with claim(tmp_path, PAPER, OLD):
            assert aside.exists()


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
def held(folder):
    """Another process works in the folder; gives it."""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(folder)], stdin=pipe, stdout=pipe) as process:
        try:
            process.stdout.readline()
            yield process
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ("run",),
        ("run", "--force", "--set", "time.end=0.1"),
        ("run", "--resume"),
        ("sweep", ROOT / "runs" / "scattering-amplitudes.toml"),
        ("nnm", ROOT / "runs" / "nnm-cubic.toml"),
        ("design",),
        ("paper", "--quick"),
    ],
)
def test_a_folder_that_another_process_works_in_is_left_alone(run, in_process, command, monkeypatch):
    """The other is named with its host; a lock that a killed process has left is nobody's."""
    monkeypatch.setattr("vipetsc.io.lock.PATIENCE", 0.1)

    def state():
        return sorted((path, path.stat().st_mtime_ns) for path in run.rglob("*"))

    with held(run) as process:
        before = state()
        ended = in_process(*command, "--out", run)
        assert ended.returncode == 2
        assert f"process {process.pid} on {os.uname().nodename} is working in it" in ended.stderr
        assert state() == before
        process.kill()
        process.wait()
        assert (run / ".lock").exists()
        with claim(run, RUN, OLD):
            pass
        assert not (run / ".lock").exists()


@pytest.mark.parametrize("folder_is_new", [False, True])
def test_a_command_waits_for_a_process_that_ends_and_says_so(run, tmp_path, caplog, folder_is_new):
    """As after ``kill -9`` of a rank: mpirun returns while another rank, which has the lock, is still ending."""
    folder = tmp_path / "new" if folder_is_new else run
    with held(folder) as process, caplog.at_level(logging.INFO, logger="vipetsc"):
        Timer(0.3, process.stdin.close).start()
        begin = time.monotonic()
        with locked(MPI.COMM_SELF, folder):
            assert 0.2 < time.monotonic() - begin < PATIENCE
            assert (folder / ".lock").read_text().startswith(f"process {os.getpid()} ")
    assert folder.exists() != folder_is_new  # created by the other, removed by it, and again by this one
    (told,) = caplog.messages
    assert f"{folder}: process {process.pid} on {os.uname().nodename} is working in it; waiting up to 5 s" in told


def test_a_folder_that_its_holder_removes_before_it_can_be_locked_is_created_again(tmp_path, monkeypatch):
    folder = tmp_path / "new"
    try_to_lock = lock._try_to_lock
    removed = []

    def remove_once(path):
        if not removed:
            path.rmdir()
            removed.append(path)
        return try_to_lock(path)

    monkeypatch.setattr(lock, "_try_to_lock", remove_once)
    with locked(MPI.COMM_SELF, folder):
        assert (folder / ".lock").exists()
    assert removed == [folder] and not folder.exists()


def test_a_command_waits_no_longer_than_it_says_for_a_process_that_stays(run, caplog, monkeypatch):
    monkeypatch.setattr("vipetsc.io.lock.PATIENCE", 0.4)
    with held(run), caplog.at_level(logging.INFO, logger="vipetsc"):
        begin = time.monotonic()
        with pytest.raises(FolderError, match="is working in it; wait until it has ended"), locked(MPI.COMM_SELF, run):
            pass
        assert 0.4 <= time.monotonic() - begin < 1.5
    assert len(caplog.messages) == 1  # said once, however often it looks


def test_a_folder_that_cannot_be_locked_is_not_left_behind(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("vipetsc.io.lock._acquire", refuse)
    with pytest.raises(PermissionError), locked(MPI.COMM_SELF, tmp_path / "a" / "b"):
        pass
    assert not any(tmp_path.iterdir())
