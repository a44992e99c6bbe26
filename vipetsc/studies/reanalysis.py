"""New analyses of finished runs: of a single run, or of all members of a sweep whose fields are stored."""

import json
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, CaseError, Sweep
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import FolderError, origin
from vipetsc.io.kinds import SWEEP
from vipetsc.io.netcdf import naming_spoilt, open_netcdf, write_netcdf
from vipetsc.io.read import open_run
from vipetsc.io.records import RecordFile
from vipetsc.parallel import on_every_rank, on_root
from vipetsc.spectra.measures import is_measure
from vipetsc.studies.analysis import analyse
from vipetsc.studies.analysis_options import options_of
from vipetsc.studies.ensemble import MISSING, Results
from vipetsc.studies.linear_run import first_site_cell, measured, read_linear
from vipetsc.studies.sweep import conclude
from vipetsc.studies.sweep_runs import keeps_all, measures_of


class MeasurableRun(NamedTuple):
    """A run in ``folder``, the folder ``sweep`` of the sweep that it may be a member of, and the ``measures`` to take.

    The measures are named as ``studies.analysis.analyse`` names them.
    """

    folder: Path
    sweep: Path
    measures: Collection[str] | None


def reanalyse_folders(paths: list[Path], comm: MPI.Comm, overrides: Sequence[str] = ()) -> list[Path]:
    """Measure the runs in ``paths`` again (folders of runs or sweeps, or ``run.h5``); returns the files written.

    Of a sweep the members whose fields are stored are measured, the others keep their measures, and the ensemble is
    assembled again. ``overrides`` ("analysis.key=value") change keys of ``[analysis]``. They are for single runs alone:
    members without stored fields cannot be measured with other options, and all members of a sweep have the same.

    The ranks of ``comm`` measure different runs; all must call it. Raises FolderError on all ranks for a path that
    contains neither runs nor a sweep, and for an override that does not apply, before anything is written; also for a
    sweep that is not finished, whose members were measured by then.
    """

    def look() -> tuple[list[MeasurableRun], list[Path]]:
        sweeps = [path for path in paths if SWEEP.is_in(path)]
        for override in overrides:
            if sweeps or not override.startswith("analysis."):
                raise FolderError(f"{override}: for an existing run only [analysis] can change, for a sweep nothing")
        # All are checked before any is measured: nothing is written if a path cannot be used.
        return [run for path in paths for run in _measurable(path)], sweeps

    runs, sweeps = on_root(comm, look)

    def measure_own() -> list[Path]:
        runs_here = runs[comm.rank :: comm.size]
        return [measure_run(run.folder, run.sweep, run.measures, overrides) for run in runs_here]

    measured_here = on_every_rank(comm, measure_own)
    written = sorted(path for from_rank in comm.allgather(measured_here) for path in from_rank)
    return written + on_root(comm, lambda: [_reassemble(folder) for folder in sweeps])


def _reassemble(folder: Path) -> Path:
    """Assemble the ensemble of the sweep in ``folder`` again; returns its path."""
    plan = Sweep.load(folder / "case.toml")
    results = Results(plan, folder)
    if (results.status == MISSING).any():
        raise FolderError(f"{folder}: the sweep is not finished; continue it with the verb sweep")

    # Of several records of a member the latest counts, in the order of the files. All that are there go into the first
    # file, so that new ones come behind those of every rank, also after a sweep that was killed before its end.
    results.merge_files()
    results = Results(plan, folder)
    file = RecordFile(results.paths.for_rank(0))
    for name in results.ids:
        path = folder / name / "analysis.h5"
        if path.exists():
            with open_netcdf(path, "analysis") as analysis:
                file.append(results.lines[name].record() | {"measures": measured(analysis)})
    file.close()
    conclude(Results(plan, folder), afresh=True)
    return folder / "ensemble.h5"


def _measurable(path: Path) -> Iterator[MeasurableRun]:
    """Yield the runs in ``path`` that can be measured, all checked; raises FolderError."""
    folder = path.parent if path.name == "run.h5" else path
    sweep = SWEEP.is_in(folder)
    if not sweep and not (folder / "run.h5").exists():
        raise FolderError(f"{path}: contains no run.h5; give the folder of a finished run or sweep")

    files = [folder / "run.h5"]
    measures: Collection[str] | None = None
    if sweep:
        files = sorted(folder.glob("*/run.h5"))
        measures = measures_of(Sweep.load(folder / "case.toml"))
    for file in files:
        try:
            with open_run(file) as run:
                if not sweep or keeps_all(Case.of(run)):
                    yield MeasurableRun(file.parent, _containing_folder(file.parent), measures)
        except (FolderError, CaseError):
            # The message says which file or key, and why.
            raise
        except (OSError, ValueError, KeyError) as error:
            raise FolderError(f"{file}: is not a run of vipetsc ({error})") from None


def _containing_folder(folder: Path) -> Path:
    """Return the folder that contains ``folder``."""
    # Made absolute: "." has no parent of its own. Not resolved: a member may be a link to another disk.
    return Path(os.path.abspath(folder)).parent


def measure_run(
    folder: Path,
    sweep: Path | None = None,
    measures: Collection[str] | None = None,
    overrides: Sequence[str] = (),
    comm: MPI.Comm = MPI.COMM_SELF,
    find_arrival: Callable[[], float | None] = lambda: None,
) -> Path:
    """Measure the run in ``folder`` and write its ``analysis.h5``; returns that file. Raises as ``open_run``.

    ``sweep`` is the folder of the sweep that the run may be a member of, by default the one in which ``folder`` lies:
    its linear run says when the wave arrives at the first site. Without a record of that run, ``find_arrival`` returns
    this time in s, or None for an estimate. ``overrides`` change keys of ``[analysis]``. The ranks of ``comm`` take
    different ones of the ``measures``, and all must call it.
    """

    def begin(stack: ExitStack) -> tuple[xr.Dataset, AnalysisTable]:
        run = stack.enter_context(open_run(folder / "run.h5"))
        return run, options_of(run.attrs["case"], folder, overrides)

    # The run stays open while all ranks measure it, and is closed on each even where one fails.
    with ExitStack() as stack:
        run, options = on_every_rank(comm, lambda: begin(stack))
        case = Case.of(run)
        # One rank looks for the record: the others must simulate together or not at all.
        linear = on_root(comm, lambda: read_linear(sweep or _containing_folder(folder), case))
        if linear:
            arrival = linear.arrival_at(first_site_cell(case))
        else:
            arrival = find_arrival()
        # Of several ranks one may fail alone: its error has to end them all.
        alone = comm.size == 1
        with naming_spoilt(lambda: [run]) if alone else nullcontext():
            analysis = analyse(run, measures, arrival=arrival, options=options, comm=comm)

    def write() -> Path:
        path = folder / "analysis.h5"
        write_netcdf(path, analysis.assign_attrs(origin() | analysis.attrs))
        _put_into_summary(folder / "summary.json", numbers_of(analysis))
        return path

    return on_root(comm, write)


def _put_into_summary(path: Path, numbers: Mapping[str, float | list[float]]) -> None:
    """Write the ``numbers`` of a run into the JSON file ``path``, its summary, if it is there; NaN becomes null."""
    if not path.exists():
        return
    summary = json.loads(path.read_text(encoding="utf-8"))
    finite = {}
    for name, value in numbers.items():
        values = [item if np.isfinite(item) else None for item in np.atleast_1d(value).tolist()]
        finite[name] = values if isinstance(value, list) else values[0]
    text = json.dumps(summary | {"measures": finite}, indent=2, allow_nan=False)
    write_text(path, text + "\n")


def numbers_of(analysis: xr.Dataset) -> dict[str, float | list[float]]:
    """Return the numbers in an ``analysis``, named as in ``spectra.measures``, without histories and maps.

    A measure of the parts of the frequency axis (bands and gaps) is a list over them.
    """
    numbers = {}
    for name in map(str, analysis.data_vars):
        is_number = not analysis[name].dims or "parts" in analysis[name].attrs
        if is_measure(name) and is_number and analysis[name].ndim < 2:
            numbers[name] = analysis[name].values.tolist()
    return numbers
