"""The runs of a sweep, each in a folder of its own: simulated and measured, or scaled from a linear run.

Until the first contact a lattice is linear, so displacements go with the drive's amplitude and energies with its
square. All members that differ in contacts and amplitude alone share one linear run under 1 N, which tells which of
them nothing touches; those are that run, scaled.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Case, case_id
from vipetsc.case.sweep import SweepTable
from vipetsc.dynamics import simulate
from vipetsc.dynamics.run import Result
from vipetsc.io.atomic import discard, write_text
from vipetsc.io.folder import provenance
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.io.read import field_time, open_run
from vipetsc.io.store import RunFolder, RunMemory, RunOutput
from vipetsc.lattice.chain import cells_between
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.studies.analysis import FULL, analyse

# A member is scaled where its linear wave stays below this share of every clearance: the largest w between samples
# exceeds the sampled envelope by less than the rest for any burst of a few cycles.
MARGIN = 0.9

T = TypeVar("T")
MEASURES = {"entropy": "entropy", "transfer": "bands"}  # what ``analyse`` calls those of ``[sweep] measures``
LAYOUT = {
    "cell": ("cell", "1", "cell, counted from 1"),
    "envelope": ("cell", "m", "largest relative displacement at 1 N"),
    "arrival": ("cell", "s", "time of the largest host velocity"),
}


class MemberStore:
    """Makes and finds the members of a sweep in ``folder``; all ranks of ``team`` work on each together.

    ``<id>/`` holds ``case.toml``, ``run.h5`` (without fields unless the sweep keeps them), ``analysis.h5`` and, last
    of all, ``summary.json``; ``linear/<id>/`` the linear runs.
    """

    def __init__(self, folder: Path, options: SweepTable, team: MPI.Comm, stop: StopRequest) -> None:
        self.folder, self.options, self.team, self.stop = folder, options, team, stop
        self.measures = FULL if self.options.fields else [MEASURES[name] for name in self.options.measures]
        self.warnings: list[str] = []  # of what this rank found
        self._linear: dict[Path, tuple[xr.Dataset, xr.Dataset]] = {}  # ledgers and measures that scaled members share
        self._requested = {"measures": sorted(self.options.measures), "fields": self.options.fields}

    def make_linear(self, case: Case) -> None:
        """Simulate the linear run of ``case``, unless this version has.

        Raises StoppedError, or RuntimeError if it does not come out.
        """
        if on_root(self.team, lambda: self.has_linear(case)):
            return
        linear, memory = linear_case(case), RunMemory(self.team)
        self._simulate(linear, memory)

        def measure() -> None:
            folder, run = linear_folder(self.folder, case), memory.dataset
            assert run is not None
            shutil.rmtree(folder, ignore_errors=True)  # what another version left
            folder.mkdir(parents=True)
            write_netcdf(folder / "run.h5", _keeping(run, linear, "velocity"))
            write_netcdf(folder / "wave.h5", linear_wave(run))

        on_root(self.team, measure)

    def has_linear(self, case: Case) -> bool:
        """Whether the linear run of ``case`` was made by this version, and its files can be read."""
        return self.wave(case) is not None and self.is_whole(linear_folder(self.folder, case) / "run.h5")

    def wave(self, case: Case) -> xr.Dataset | None:
        """The linear wave of ``case`` as this version made it; None if it has not, or the file cannot be read."""
        path = linear_folder(self.folder, case) / "wave.h5"
        return self._readable(path, lambda path: read_wave(self.folder, case, current=True))

    def summary(self, case: Case, current: bool = False) -> dict[str, Any]:
        """``summary.json`` of the member of ``case``; empty if it lacks anything that the sweep asks for.

        If ``current``, empty too if another version made it. Files that cannot be read count as not there.
        """
        folder = self.folder / case_id(case)
        summary = self._readable(folder / "summary.json", lambda path: json.loads(path.read_bytes())) or {}
        asked = self._requested | {"complete": True} | ({"vipetsc_version": vipetsc.__version__} if current else {})
        files = folder / "run.h5", folder / "analysis.h5"
        return summary if asked.items() <= summary.items() and all(map(self.is_whole, files)) else {}

    def is_whole(self, path: Path) -> bool:
        """Whether the HDF5 file ``path`` is there and was not cut off, which HDF5 sees when it opens it."""
        return self._readable(path, lambda path: h5py.File(path).close() or True) is not None

    def _readable(self, path: Path, read: Callable[[Path], T]) -> T | None:
        """What ``read`` makes of a file; None if it is not there, or was cut off, which is noted."""
        try:
            return read(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            self.warnings.append(f"{path} cannot be read: {error}; made again")
            return None

    def make(self, case: Case, wave: xr.Dataset) -> None:
        """Simulate the member of ``case``, or scale it; raises as ``make_linear``."""
        folder, whole = self.folder / case_id(case), self.options.fields
        if not whole and np.all(reached(wave, case) < MARGIN):
            on_root(self.team, lambda: self._scale(case, folder, wave))
            return

        def begin() -> None:
            """A run with its fields that was cut off goes on, if it is of this version."""
            marker, text = folder / "case.toml", case.to_toml()
            if not marker.exists() or marker.read_text(encoding="utf-8") != text:
                discard(folder)
                folder.mkdir()
                write_text(marker, text)

        memory = RunMemory(self.team)
        if whole:
            on_root(self.team, begin)
        simulated, output = (case, RunFolder(folder, self.team)) if whole else (_gathered(case, "velocity"), memory)
        result = self._simulate(simulated, output)

        def measure() -> None:
            if memory.dataset is None:
                summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
            else:
                folder.mkdir(exist_ok=True)
                write_netcdf(folder / "run.h5", _keeping(memory.dataset, case))
                ended = {"status": result.sentence, "complete": True, "statistics": result.statistics}
                summary = provenance(self.team) | ended
            with open_run(folder / "run.h5") if memory.dataset is None else memory.dataset as run:
                measured = analyse(run, self.measures, arrival_at(wave, case))
            write_netcdf(folder / "analysis.h5", measured)
            warnings = json.loads(measured.attrs.get("warnings", "[]"))
            self._finish(folder, case, summary | {"warnings": [*result.warnings, *warnings]})

        on_root(self.team, measure)

    def _simulate(self, case: Case, output: RunOutput) -> Result:
        result = simulate(case, output, self.team, stop=self.stop)
        if result.resumable:
            raise StoppedError(result.sentence)
        if not result.complete:
            raise RuntimeError(result.sentence)
        return result

    def _scale(self, case: Case, folder: Path, wave: xr.Dataset) -> None:
        """The member from its linear run: fields go with the amplitude, energies with its square."""
        source, factor = linear_folder(self.folder, case), case.drive.amplitude**2
        # All members with the same first site share these measures, whichever rank needs them first.
        shared = source / f"analysis-{leading_cell(case)}-{'-'.join(sorted(self.options.measures))}.h5"
        if shared not in self._linear:
            with open_run(source / "run.h5") as run:
                if not self.is_whole(shared):
                    write_netcdf(shared, analyse(with_sites(run, case), self.measures, arrival_at(wave, case)))
                with open_netcdf(shared, "analysis") as file:
                    self._linear[shared] = run.drop_vars("velocity").load(), file.load()
        linear, measured = self._linear[shared]
        run = scaled(with_sites(linear, case), factor)
        statistics = json.loads(run.attrs["statistics"]) | {"episodes": 0, "scaled_from": source.name}
        statistics |= {"work": float(run["energy/work"][-1]), "dissipated": 0.0}
        status = "complete: scaled from the linear run"
        summary = provenance(self.team) | {"status": status, "complete": True, "statistics": statistics}
        folder.mkdir(exist_ok=True)
        write_netcdf(folder / "run.h5", _keeping(run.assign_attrs(summary), case))
        analysis = scaled(measured, factor).assign_attrs(case=case.to_toml(), status=status)
        write_netcdf(folder / "analysis.h5", analysis)
        self._finish(folder, case, summary)

    def _finish(self, folder: Path, case: Case, summary: dict[str, Any]) -> None:
        """Write what shows that a member is complete, the summary last."""
        write_text(folder / "case.toml", case.to_toml())
        summary = summary | self._requested | {"case": case.model_dump(by_alias=True)}
        write_text(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")


def _gathered(case: Case, *fields: str) -> Case:
    """``case`` with these fields of all cells at all samples, gathered on one rank."""
    output = {"fields": list(fields), "window": None, "every": 1, "stride": 1, "writer": "gather"}
    return case.model_copy(update={"output": case.output.model_copy(update=output)})


def _keeping(run: xr.Dataset, case: Case, *fields: str) -> xr.Dataset:
    """``run`` of ``case`` with these of its fields alone."""
    dropped = [name for name in ("displacement", "velocity") if name in run and name not in fields]
    return run.drop_vars(dropped).assign_attrs(case=_gathered(case, *fields).to_toml())


def linear_wave(run: xr.Dataset) -> xr.Dataset:
    """Measure a linear run with both fields of all cells.

    ``envelope`` (cell): largest sqrt(w^2 + (w'/Om)^2) in m of the contact pair's relative displacement w, Om the
    drive's angular frequency. ``arrival`` (cell): time in s of the largest host velocity, the paper's t_hat when taken
    at the first site.
    """
    model = Case.of(run).model()
    cell, fields = model.chain.cell, (run["displacement"].values, run["velocity"].values)
    w, rate = (field[..., cell.resonator] - field[..., cell.host] for field in fields)
    envelope = np.sqrt(np.max(w**2 + (rate / model.drive.frequency) ** 2, axis=0))
    arrival = field_time(run)[np.argmax(np.abs(fields[1][..., cell.host]), axis=0)]
    values = {"cell": np.arange(1, len(envelope) + 1), "envelope": envelope, "arrival": arrival}
    return xr.Dataset(tabulated(LAYOUT, values), attrs={"vipetsc_version": vipetsc.__version__})


def linear_folder(sweep: Path, case: Case) -> Path:
    """Where the folder of a ``sweep`` holds the linear run of ``case``."""
    return sweep / "linear" / case_id(linear_case(case))


def read_wave(sweep: Path, case: Case, current: bool = False) -> xr.Dataset | None:
    """The linear wave of ``case``; None if it has not been made, by this version of the package if ``current``."""
    path = linear_folder(sweep, case) / "wave.h5"
    if not path.exists():
        return None
    with open_netcdf(path, "linear wave", ("envelope", "arrival")) as file:
        return file.load() if not current or file.attrs.get("vipetsc_version") == vipetsc.__version__ else None


def reached(wave: xr.Dataset, case: Case) -> np.ndarray:
    """Linear relative displacement over clearance (site) at the amplitude of ``case``."""
    envelope = wave["envelope"].values[np.asarray(case.contacts.sites, int) - 1]
    return np.asarray(abs(case.drive.amplitude) * envelope / np.asarray(case.contacts.clearance or [], float))


def arrival_at(wave: xr.Dataset | None, case: Case) -> float | None:
    """The paper's t_hat in s, when the wave is largest at the first site of ``case``; None without wave or sites."""
    cell = leading_cell(case)
    return float(wave["arrival"][cell - 1]) if wave is not None and cell else None


def leading_cell(case: Case) -> int:
    """Cell (1-based) of the site nearest to the drive; 0 without sites."""
    cells = np.asarray(case.contacts.sites, np.int64)
    distance = cells_between(cells, case.drive.cell, case.lattice.cells, case.lattice.ends)
    return int(cells[np.argmin(distance)]) if cells.size else 0


def linear_case(case: Case) -> Case:
    """The lattice of ``case`` without contacts under 1 N; cases that differ in those alone share it."""
    table = case.model_dump(by_alias=True, exclude_none=True)
    table["contacts"] = {"sites": 0}
    table["drive"]["amplitude"] = 1.0
    table["output"] = {}
    return Case.from_table(table | {"name": "linear"})


def with_sites(linear: xr.Dataset, case: Case) -> xr.Dataset:
    """The ``linear`` run as a run of ``case`` under 1 N whose sites nothing touches."""
    sites = np.asarray(case.contacts.sites, np.int64)
    values: dict[str, Any] = {"site": np.arange(1, len(sites) + 1), "sites/cell": sites}
    values["sites/clearance"] = np.asarray(case.contacts.clearance or [], float)
    values["energy/dissipated_by_site"] = np.zeros((linear.sizes["time"], len(sites)))
    variables = {name: (linear[name].dims, value, linear[name].attrs) for name, value in values.items()}
    unit = Case.from_table(case.model_dump(by_alias=True, exclude_none=True), ["drive.amplitude=1.0"])
    return linear.drop_dims("site").assign(variables).assign_attrs(case=unit.to_toml())


def scaled(data: xr.Dataset, factor: float) -> xr.Dataset:
    """``data`` with all energies (in J) times ``factor``."""
    energies = [name for name in data.data_vars if data[name].attrs.get("units") == "J"]
    with xr.set_options(keep_attrs=True):
        return data.assign({name: data[name] * factor for name in energies})
