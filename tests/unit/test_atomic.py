"""Files that are whole or not there, whatever writes them and whatever happens."""

import errno
import os
import resource
from contextlib import contextmanager

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures.style import save
from vipetsc.io.atomic import atomic_write, load_arrays, save_arrays, write_text
from vipetsc.io.netcdf import open_netcdf, variable, write_netcdf
from vipetsc.io.read import open_ensemble, open_run


@contextmanager
def full_disk(limit):
    """No file of this process grows beyond ``limit`` bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


NUMBERS = np.arange(10_000.0)
WRITERS = {
    "a.txt": lambda path: write_text(path, "long " * 20_000),
    "a.npy": lambda path: save_arrays(path, {"x": NUMBERS}),
    "a.h5": lambda path: write_netcdf(path, xr.Dataset({"x": variable("x", NUMBERS, "1", "x")})),
    "a.png": lambda path: save(Figure(), path),
}


@pytest.mark.parametrize("limit", [0, 1000])
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_leaves_what_was_there_and_names_the_file(tmp_path, name, limit):
    (tmp_path / name).write_text("earlier")
    with full_disk(limit), pytest.raises(OSError, match=rf"{name} could not be written: File too large") as caught:
        WRITERS[name](tmp_path / name)
    assert caught.value.errno == errno.EFBIG
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "earlier"
    WRITERS[name](tmp_path / name)  # nothing crashes afterwards


def test_temporary_names_are_not_those_of_another_host_or_process(tmp_path, monkeypatch):
    names = []
    for host, process in (("one", 7), ("two", 7), ("two", 7)):
        monkeypatch.setattr("platform.node", lambda host=host: host)
        monkeypatch.setattr(os, "getpid", lambda process=process: process)
        with atomic_write(tmp_path / "a") as aside:
            aside.touch()
            names.append(aside.name)
    assert len(set(names)) == 3


def opened_run(path):
    with open_run(path):
        pass


@pytest.mark.parametrize("content", [b"", b"cut", None])
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("state.npy", load_arrays),
        ("run.h5", opened_run),
        ("analysis.h5", lambda path: open_netcdf(path, "analysis")),
        ("ensemble.h5", lambda path: open_ensemble(path.parent)),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, name, read, content):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(OSError, match=str(tmp_path / name)):
        read(tmp_path / name)


def test_a_file_cut_in_the_middle_is_named(tmp_path):
    for name in ("a.npy", "a.h5"):
        WRITERS[name](tmp_path / name)
        whole = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(whole[: len(whole) // 2])
    for read in (lambda: load_arrays(tmp_path / "a.npy"), lambda: open_netcdf(tmp_path / "a.h5", "run")):
        with pytest.raises(OSError, match="/a\\.") as caught:
            read()
        assert str(tmp_path) in str(caught.value)
