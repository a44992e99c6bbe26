"""Results with NaN, infinite numbers or no sample: every figure is drawn of the rest, or one sentence says why not."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.conftest import small_case
from tests.faults.scenarios import PLAIN, SCENARIOS, TEAM, prepare, words_of
from vipetsc.dynamics import simulate
from vipetsc.figures import style
from vipetsc.figures.registry import draw, figure_names
from vipetsc.io.errors import FolderError
from vipetsc.io.netcdf import open_netcdf, write_netcdf

# Sources of figures, by the scenarios whose results they are.
SOURCES = {
    "run": "run",
    "analyse": "sweep",
    "nnm": "branches",
    "nfrc": "branches",
    "design": "design",
    "law": "law",
    "identify": "identification",
}
SPOILT = ("nan", "all nan", "infinite", "empty")
TRIALS = 8  # of the results of a source; all variables, kinds and figures take minutes a source


def spoil(path: Path, name: str, kind: str) -> None:
    """Make numbers of the variable ``name`` in a file what ``kind`` says, or its first dimension empty."""
    if kind == "empty":
        with open_netcdf(path, "result") as opened:
            data = opened.load()
        if data[name].dims:
            write_netcdf(path, data.isel({data[name].dims[0]: slice(0, 0)}))
        return

    with h5py.File(path, "r+") as file:
        values = np.atleast_1d(file[name][()])
        if kind == "all nan":
            values[...] = np.nan
        else:
            values.flat[values.size // 2] = {"nan": np.nan, "infinite": np.inf}[kind]
        file[name][...] = values.reshape(file[name].shape)


def numbers_in(path: Path) -> list[str]:
    """Return the names of all variables with floating-point numbers in a file."""
    found: list[str] = []

    def note(name: str, item: h5py.Dataset | h5py.Group) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "f" and item.size:
            found.append(name)

    with h5py.File(path) as file:
        file.visititems(note)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SOURCES)
def test_figures_of_spoilt_results_are_drawn_or_refused_in_a_sentence(in_process, tmp_path, monkeypatch, scenario):
    """Variables are spoilt, with the kinds and the figures in turn: nothing but the package's own errors."""
    monkeypatch.setattr(style, "SCREEN", 30)
    whole = tmp_path / "whole"
    case = prepare(SCENARIOS[scenario], tmp_path)
    if scenario == "analyse":
        case.write_text(TEAM.replace("ranks = 2", "").replace('["entropy"]', '["entropy", "transfer"]'))
    words = (SCENARIOS[scenario].before or SCENARIOS[scenario].words) + f" {PLAIN}"
    assert in_process(*words_of(words, case, whole)).returncode == 0

    source = SOURCES[scenario]
    figures = figure_names(source, folders=[whole])
    # Of the files of a sweep's members those of one are enough.
    files = sorted(whole.glob("*.h5")) + sorted(whole.glob("*/*.h5"))[-2:]
    spoilt = [(file.relative_to(whole), name) for file in files for name in numbers_in(file)]
    spoilt = spoilt[:: max(len(spoilt) // TRIALS, 1)]
    folder = tmp_path / "spoilt"
    shutil.copytree(whole, folder)
    found = []
    for number, (file, name) in enumerate(spoilt):
        kind = SPOILT[number % len(SPOILT)]
        figure = figures[(number + number // len(SPOILT)) % len(figures)]
        spoil(folder / file, name, kind)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                draw(source, [folder], [figure])
        except FolderError:
            pass
        except Exception as error:
            found.append(f"{figure} with {kind} in {file} {name}: {type(error).__name__}: {error}")
        shutil.copy(whole / file, folder / file)
    assert found == []


@pytest.mark.parametrize("kind", ["nan", "all nan"])
@pytest.mark.parametrize("words", ["analyse", "plot", "plot --fig spacetime", "plot --movie --format gif"])
def test_a_run_with_nan_in_its_field_is_measured_or_refused_in_a_sentence(in_process, tmp_path, words, kind):
    """A refusal names the file and the variable; what can be drawn or measured of the rest is."""
    out = tmp_path / "out"
    simulate(small_case(), out)
    spoil(out / "run.h5", "velocity", kind)
    verb, *options = words.split()
    ended = in_process(verb, out, *options)
    assert "Traceback" not in ended.stderr
    assert ended.returncode == 0 or (ended.returncode == 2 and "run.h5 holds numbers" in ended.stderr)
    if kind == "all nan" and "--movie" not in words:
        assert ended.returncode == 2
