"""Every writer leaves a whole file or none, also on a full disk; a file that cannot be read is named."""

import errno
import fcntl
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures.style import save
from vipetsc.io.atomic import atomic_write, remove_abandoned, write_text
from vipetsc.io.hdf5 import StoredArrays, save_arrays
from vipetsc.io.lock import FolderError, locked
from vipetsc.io.netcdf import open_netcdf, variable, write_netcdf
from vipetsc.io.read import open_ensemble, open_run


@contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """Let no file of this process grow beyond ``limit`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# Each function writes a file that is longer than the limits in bytes below.
NUMBERS = np.arange(10_000.0)
WRITERS = {
    "a.txt": lambda path: write_text(path, "long " * 20_000),
    "arrays.h5": lambda path: save_arrays(path, {"x": NUMBERS}),
    "a.h5": lambda path: write_netcdf(path, xr.Dataset({"x": variable("x", NUMBERS, "1", "x")})),
    "a.png": lambda path: save(Figure(), path),
}


@pytest.mark.parametrize("limit", [0, 1000])
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_the_earlier_file_and_names_it(tmp_path, name, limit):
    """A write that finds no space raises OSError with the file's name; the earlier file stays, and no temporary one."""
    path = tmp_path / name
    path.write_text("earlier")

    with full_disk(limit), pytest.raises(OSError, match=rf"{name} could not be written: File too large") as caught:
        WRITERS[name](path)

    assert caught.value.errno == errno.EFBIG
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    assert path.read_text() == "earlier"
    # HDF5 crashes later if a file that it could not flush stays open.
    WRITERS[name](path)


def test_only_temporary_files_of_processes_that_have_ended_are_removed(tmp_path, monkeypatch):
    """A folder that is not locked may hold files that another command, here or on another host, is writing."""
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    monkeypatch.setattr(os, "getpid", lambda: ended.pid)
    # The context is entered and never left, as in a process that is killed.
    abandoned = atomic_write(tmp_path / "a.png").__enter__()
    here = platform.node()
    others = []
    # Another host may have a name that equals this host's name with a number of a process.
    for name in ("elsewhere", f"{here}-{ended.pid}"):
        monkeypatch.setattr(platform, "node", lambda name=name: name)
        others.append(atomic_write(tmp_path / "a.png").__enter__())
    monkeypatch.undo()
    written = atomic_write(tmp_path / "a.png").__enter__()
    for path in (abandoned, *others, written):
        path.touch()

    remove_abandoned(tmp_path)
    assert {*tmp_path.iterdir()} == {*others, written}


def open_and_close_run(path: Path) -> None:
    with open_run(path):
        pass


@pytest.mark.parametrize("content", [b"", b"cut", None])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("state.h5", StoredArrays),
        ("run.h5", open_and_close_run),
        ("analysis.h5", lambda path: open_netcdf(path, "analysis")),
        ("ensemble.h5", lambda path: open_ensemble(path.parent)),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, name, read, content):
    """An empty file, one of another kind and a missing one raise OSError with the file's name."""
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(OSError, match=str(path)):
        read(path)


def test_a_lock_that_cannot_be_written_is_given_back(tmp_path):
    """A process that goes on after the error, as a notebook does, can take the lock again, and so can others."""
    with full_disk(0), pytest.raises(FolderError, match="File too large"), locked(MPI.COMM_SELF, tmp_path):
        pass
    with (tmp_path / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
