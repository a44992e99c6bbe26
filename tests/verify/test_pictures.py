"""What holds for every picture, whatever it shows: a registry of figures times a zoo of small results.

Each figure is drawn, or gives its reason; what it draws can be read. A new figure is checked by being registered.
"""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from tests.coarse import coarse_pictures
from tests.hertz_branch import write_branch
from tests.readable import complaints
from tests.studies import compute
from tests.unit.test_branch_figure import put_condensed_branch
from tests.unit.test_figures import write_run
from tests.verify.test_measures_of_runs import IMPACT
from tests.verify.test_paper_curves import swept
from vipetsc.case import Case, Sweep
from vipetsc.dynamics import simulate
from vipetsc.figures import style
from vipetsc.figures.registry import FIGURES, draw, drawings, figure_names
from vipetsc.figures.style import NoPicture, rc_style, save
from vipetsc.figures.sweep_members import Files
from vipetsc.io.errors import FolderError
from vipetsc.io.netcdf import open_netcdf, write_netcdf
from vipetsc.studies.backbone import relate_folders
from vipetsc.studies.reanalysis import measure_run
from vipetsc.studies.sweep import run_sweep


def study(name: str, *changes: str) -> Callable[[Path], list[Path]]:
    """Return a function that computes a study of ``tests/studies.py``, with changes, into a folder."""

    def make(folder: Path) -> list[Path]:
        compute(name, folder, MPI.COMM_SELF, *changes)
        return [folder]

    return make


def on_a_strip(folder: Path) -> list[Path]:
    """Simulate a strip of 8 x 4 cells with a stop."""
    lattice = {"cells": 8, "ends": "periodic"}
    lattice["strip"] = {"rows": 4, "kind": "square", "mass": 0.01, "stiffness": 1e4, "edges": "periodic"}
    contacts = {"places": [[4, 2]], "clearance": 2e-4, "stiffness": 1e7}
    drive = {"amplitude": 20.0, "waveform": "harmonic", "frequency": 1500.0, "place": [3, 2]}
    table = {"name": "strip", "lattice": lattice, "contacts": contacts, "drive": drive, "time": {"end": 0.02}}
    simulate(Case.from_table(table), folder)
    measure_run(folder)
    return [folder]


def travelling(folder: Path) -> list[Path]:
    """Write a run with a travelling wave."""
    write_run(folder / "run.h5")
    measure_run(folder)
    return [folder]


def repeating(folder: Path) -> list[Path]:
    """Simulate a motion of a named point that repeats itself, sampled by its period."""
    short = IMPACT | {"time": IMPACT["time"] | {"end": 60.0}}
    simulate(Case.from_table(short), folder, MPI.COMM_SELF)
    measure_run(folder)
    return [folder]


def bifurcating(folder: Path) -> list[Path]:
    """Sweep the drive's frequency of such a motion."""
    table = IMPACT | {
        "time": IMPACT["time"] | {"end": 60.0},
        "sweep": {"fields": True, "measures": ["motion"], "drive": {"frequency": [2.2, 2.3, 2.4]}},
    }
    run_sweep(Sweep.from_table(table), folder, MPI.COMM_SELF)
    return [folder]


def scattered(folder: Path) -> list[Path]:
    """Sweep three amplitudes, and keep the fields of all members."""
    return study("sweep-team", "sweep.ranks=1")(folder)


def transferred(folder: Path) -> list[Path]:
    """Sweep amplitudes, two of them with fields, beside a branch of the same law."""
    table = {"contacts": {"law": ["hertz"]}, "drive": {"amplitude": [1.0, 30.0, 60.0, 120.0, 240.0]}, "fields": True}
    branch = folder / "branch"
    branch.mkdir()
    write_branch(branch, largest=1e6, last_region=1e5)
    sweep = swept(folder / "sweep", **table)
    relate_folders([sweep, branch])
    return [sweep, branch]


def condensed(folder: Path) -> list[Path]:
    """Write a condensed branch of three points."""
    put_condensed_branch(folder / "branch-breather.h5", 3)
    return [folder]


# Results by their names: the source of their figures, and the function that makes them in a folder.
ZOO: dict[str, tuple[str, Callable[[Path], list[Path]]]] = {
    "travelling wave": ("run", travelling),
    "repeating motion": ("run", repeating),
    "strip": ("run", on_a_strip),
    "bifurcations": ("sweep", bifurcating),
    "entropies": ("sweep", scattered),
    "transfer": ("sweep", transferred),
    "orbits": ("branches", study("nnm")),
    "condensed branch": ("branches", condensed),
    "responses over a key": ("branches", study("nfrc-over-key")),
    "responses": ("branches", study("nfrc")),
    "design": ("design", study("design", "design.lambda.count=4", "design.eta.count=10")),
    "law": ("law", study("law")),
    "prediction": ("prediction", study("predict")),
    "front": ("optimum", study("optimise-front")),
    "identification": ("identification", study("identify", "identify.profile=3")),
}
SPOILT = ("nan", "all nan", "infinite", "empty")
TRIALS = 5  # of the results of each kind; all variables, faults and figures take minutes
# Labels of pure numbers: ratios, fractions, counts, places. Every other label has a unit in brackets.
PURE = re.compile(
    r"|.*(/|raction|elative|misfit|deviance|autocorrelation|% from).*|Cell|cell|Cell i|Row j|Episodes|Bin|Design"
    r"|direction|valley|window|λ|η|z - 1|distance from the end|between its bounds|κ\* = .*"
)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Callable[[str], list[Path]]:
    """Return a function that gives the folders of the results of a name, made once."""
    made: dict[str, list[Path]] = {}

    def get(name: str) -> list[Path]:
        if name not in made:
            made[name] = ZOO[name][1](tmp_path_factory.mktemp("results"))
        return made[name]

    return get


def faults(figure: Figure) -> list[str]:
    """Return a sentence for each fault of a figure: of its texts, its labels and its limits."""
    found = complaints(figure)
    shown = [axes for axes in figure.get_axes() if axes.axison]
    for axes in shown:
        limits = (*axes.get_xlim(), *axes.get_ylim())
        if not np.isfinite(limits).all():
            found.append(f"limits: {limits}")
        for label in (axes.get_xlabel(), axes.get_ylabel()):
            # A row of panels has the name of what it shows before its label.
            if not PURE.fullmatch(label.rpartition("\n")[2]) and not re.search(r"\([^)]+\)", label):
                found.append(f"no unit: {label!r}")

    parts = [figure, *figure.subfigs]
    together = any(part._supxlabel or part._supylabel for part in parts)
    if shown and not together and not any(axes.get_xlabel() for axes in shown):
        found.append("no axis has a label")
    return found


def drawn(name: str, figures: list[str], folders: list[Path], path: Path) -> dict[str, list[str]]:
    """Draw figures of the results of a name to a path; return the faults of each by its stem."""
    found = {}
    source, _ = ZOO[name]
    with rc_style(), Files() as files:
        for drawing in drawings(source, folders, files, figures):
            try:
                figure = drawing.draw()
            except NoPicture as none:
                # The reason is a sentence for the user.
                assert len(str(none)) > 10
                continue
            save(figure, path)
            # A picture of one colour shows nothing.
            assert np.ptp(imread(path)[..., :3]) > 0.5
            found[drawing.stem] = faults(figure)
    return found


@pytest.mark.parametrize("figure", FIGURES)
def test_every_figure_is_drawn_from_some_results_or_gives_its_reason(results, figure, tmp_path, monkeypatch):
    """What is drawn can be read; of other results of the kind a sentence says why there is no picture."""
    monkeypatch.setattr(style, "SCREEN", 80)
    found = {}
    for name, (source, _) in ZOO.items():
        if source == FIGURES[figure].kind.source:
            found |= drawn(name, [figure], results(name), tmp_path / "picture.png")
    assert found, "no results of the zoo have this figure"
    assert {stem: said for stem, said in found.items() if said} == {}


@pytest.mark.parametrize("name", [name for name, (source, _) in ZOO.items() if source == "sweep"])
def test_every_measure_of_a_sweep_has_a_page_or_a_reason(results, name, tmp_path, monkeypatch):
    """All pages that a sweep offers, asked for by name, can be read."""
    monkeypatch.setattr(style, "SCREEN", 80)
    measures = [measure for measure in figure_names("sweep", None, results(name)) if measure not in FIGURES]
    found = drawn(name, measures, results(name), tmp_path / "picture.png")
    assert found
    assert {stem: said for stem, said in found.items() if said} == {}


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

    def note(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "f" and item.size:
            found.append(name)

    with h5py.File(path) as file:
        file.visititems(note)
    return found


@pytest.mark.parametrize("name", [name for name in ZOO if name != "transfer"])
def test_figures_of_spoilt_results_are_drawn_or_refused(results, tmp_path, monkeypatch, name):
    """Variables are spoilt, with the kinds and the figures in turn: nothing but the package's own errors."""
    coarse_pictures(monkeypatch.setattr)
    source, _ = ZOO[name]
    (whole,) = results(name)
    figures = figure_names(source, folders=[whole])
    # Of the files of a sweep's members those of one are enough.
    files = sorted(whole.glob("*.h5")) + sorted(whole.glob("*/*.h5"))[-2:]
    spoilt = [(file.relative_to(whole), variable) for file in files for variable in numbers_in(file)]
    spoilt = spoilt[:: max(len(spoilt) // TRIALS, 1)]
    folder = shutil.copytree(whole, tmp_path / "spoilt")
    found = []
    for number, (file, variable) in enumerate(spoilt):
        kind = SPOILT[number % len(SPOILT)]
        figure = figures[(number + number // len(SPOILT)) % len(figures)]
        spoil(folder / file, variable, kind)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                draw(source, [folder], [figure])
        except FolderError:
            pass
        except Exception as error:
            found.append(f"{figure} with {kind} in {file} {variable}: {type(error).__name__}: {error}")
        shutil.copy(whole / file, folder / file)
    assert found == []


@pytest.mark.parametrize("kind", ["nan", "all nan"])
@pytest.mark.parametrize("words", ["analyse", "plot --fig spacetime", "plot --movie --format gif"])
def test_a_run_with_nan_in_its_field_is_measured_or_refused(in_process, results, tmp_path, words, kind):
    """A refusal names the file; what can be drawn or measured of the rest is."""
    (whole,) = results("travelling wave")
    out = shutil.copytree(whole, tmp_path / "out")
    # Some figures can be drawn from the analysis alone.
    (out / "analysis.h5").unlink()
    spoil(out / "run.h5", "velocity", kind)
    verb, *options = words.split()
    ended = in_process(verb, out, *options)
    assert "Traceback" not in ended.stderr
    assert ended.returncode == 0 or (ended.returncode == 2 and "run.h5" in ended.stderr)
    if kind == "all nan" and "--movie" not in words:
        assert ended.returncode == 2
