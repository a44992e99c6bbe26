"""The runs of a sweep, each in a folder of its own: simulated and measured, or scaled from a linear run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Case, case_id
from vipetsc.case.sweep import SweepTable
from vipetsc.dynamics import simulate
from vipetsc.dynamics.run import Result
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import provenance
from vipetsc.io.netcdf import open_netcdf, write_netcdf
from vipetsc.io.read import open_run
from vipetsc.io.store import RunMemory
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.analysis import FULL, REDUCED, analyse
from vipetsc.studies.linear import arrival_at, leading_cell, linear_case, linear_wave, reached, scaled, with_sites

# A member is scaled where its linear wave stays below this share of every clearance: the largest w between samples
# exceeds the sampled envelope by less than the rest for any burst of a few cycles.
MARGIN = 0.9

MEASURES = {"entropy": "entropy", "transfer": "bands"}
"""What ``analyse`` calls the measures of ``[sweep] measures``."""


class StoppedError(Exception):
    """A member was left because the sweep was asked to stop."""


class MemberStore:
    """Makes and finds the members of a sweep in ``folder``; all ranks of ``team`` work on each together.

    ``<id>/`` holds ``case.toml``, ``run.h5`` (without fields unless the sweep keeps them), ``analysis.h5`` and, last
    of all, ``summary.json``; ``linear/<id>/`` the linear runs.
    """

    def __init__(
        self,
        folder: Path,
        options: SweepTable | None = None,
        team: MPI.Comm = MPI.COMM_SELF,
        stop: StopRequest | None = None,
    ) -> None:
        self.folder, self.options = folder, options or SweepTable.model_validate({})
        self.team, self.stop = team, stop or StopRequest()
        asked = [MEASURES[name] for name in self.options.measures]
        self.measures = FULL if self.options.fields else tuple(m for m in REDUCED if m in asked)
        self._linear: dict[Path, tuple[xr.Dataset, xr.Dataset]] = {}  # ledgers and measures that scaled members share
        self._requested = {"measures": sorted(self.options.measures), "fields": self.options.fields}

    def linear_folder(self, case: Case) -> Path:
        """Where the linear run of ``case`` belongs."""
        return self.folder / "linear" / case_id(linear_case(case))

    def wave(self, case: Case) -> xr.Dataset | None:
        """The linear wave of ``case``; None if it has not been made."""
        path = self.linear_folder(case) / "wave.h5"
        if not path.exists():
            return None
        with open_netcdf(path, "linear wave", ("envelope", "arrival")) as file:
            return file.load()

    def has_wave(self, case: Case) -> bool:
        """Whether the linear wave of ``case`` has been made by this version of the package."""
        wave = self.wave(case)
        return wave is not None and wave.attrs.get("vipetsc_version") == vipetsc.__version__

    def make_linear(self, case: Case) -> None:
        """Simulate the linear run of ``case``; raises StoppedError, or RuntimeError if it does not come out."""
        linear, memory = linear_case(case), RunMemory(self.team)
        self._check(simulate(linear, memory, self.team, stop=self.stop))

        def measure() -> None:
            folder, run = self.linear_folder(case), memory.dataset
            assert run is not None
            shutil.rmtree(folder, ignore_errors=True)  # what another version left
            folder.mkdir(parents=True)
            write_netcdf(folder / "run.h5", _keeping(run, linear, "velocity"))
            write_netcdf(folder / "wave.h5", linear_wave(run))

        on_root(self.team, measure)

    def is_complete(self, case: Case) -> bool:
        """Whether the member of ``case`` is there with all that the sweep asks for."""
        summary = self.summary(case)
        return bool(summary.get("complete")) and all(summary.get(k) == v for k, v in self._requested.items())

    def is_current(self, case: Case) -> bool:
        """Whether the member of ``case`` is complete and was made by this version of the package."""
        return self.is_complete(case) and self.summary(case).get("vipetsc_version") == vipetsc.__version__

    def summary(self, case: Case) -> dict[str, Any]:
        """``summary.json`` of the member of ``case``; empty if there is none."""
        path = self.folder / case_id(case) / "summary.json"
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        return summary

    def make(self, case: Case, wave: xr.Dataset) -> None:
        """Simulate the member of ``case``, or scale it; raises as ``make_linear``."""
        folder, whole = self.folder / case_id(case), self.options.fields
        if not whole and np.all(reached(wave, case) < MARGIN):
            on_root(self.team, lambda: self._scale(case, folder, wave))
            return

        def is_begun() -> bool:
            """Whether a run with its fields was cut off; one killed before it had begun is dropped."""
            marker = folder / "case.toml"
            if whole and folder.is_dir() and not marker.exists():
                shutil.rmtree(folder)
            return whole and (folder / "parts").is_dir() and marker.read_text(encoding="utf-8") == case.to_toml()

        begun, memory = on_root(self.team, is_begun), RunMemory(self.team)
        simulated, output = (case, folder) if whole else (_gathered(case, "velocity"), memory)
        result = simulate(simulated, output, self.team, force=not begun, resume=begun, stop=self.stop)
        self._check(result)

        def measure() -> None:
            folder.mkdir(exist_ok=True)
            summary = provenance(self.team) | {"status": result.sentence, "complete": True}
            if memory.dataset is not None:
                write_netcdf(folder / "run.h5", _keeping(memory.dataset, case))
            with open_run(folder / "run.h5") if memory.dataset is None else memory.dataset as run:
                write_netcdf(folder / "analysis.h5", analyse(run, self.measures, arrival_at(wave, case)))
            summary["statistics"] = result.statistics
            self._finish(folder, case, self.summary(case) if whole else summary)

        on_root(self.team, measure)

    @staticmethod
    def _check(result: Result) -> None:
        if result.resumable:
            raise StoppedError
        if not result.complete:
            raise RuntimeError(result.sentence)

    def _scale(self, case: Case, folder: Path, wave: xr.Dataset) -> None:
        """The member from its linear run: fields go with the amplitude, energies with its square."""
        source, factor = self.linear_folder(case), case.drive.amplitude**2
        # All members with the same first site share these measures, whichever rank needs them first.
        shared = source / f"analysis-{leading_cell(case)}-{'-'.join(sorted(self.options.measures))}.h5"
        if shared not in self._linear:
            with open_run(source / "run.h5") as run:
                if not shared.exists():
                    write_netcdf(shared, analyse(with_sites(run, case), self.measures, arrival_at(wave, case)))
                with open_netcdf(shared, "analysis") as analysis:
                    self._linear[shared] = run.drop_vars("velocity").load(), analysis.load()
        linear, measured = self._linear[shared]
        run = scaled(with_sites(linear, case), factor)
        statistics = json.loads(run.attrs["statistics"]) | {"episodes": 0, "scaled_from": source.name}
        statistics |= {"work": float(run["energy/work"][-1]), "dissipated": 0.0}
        about = {"status": "complete: scaled from the linear run", "complete": True, "statistics": statistics}
        summary = provenance(self.team) | about
        folder.mkdir(exist_ok=True)
        write_netcdf(folder / "run.h5", _keeping(run.assign_attrs(summary), case))
        about = {"case": case.to_toml(), "status": summary["status"]}
        write_netcdf(folder / "analysis.h5", scaled(measured, factor).assign_attrs(about))
        self._finish(folder, case, summary)

    def _finish(self, folder: Path, case: Case, summary: dict[str, Any]) -> None:
        """Write what shows that a member is complete, the summary last."""
        write_text(folder / "case.toml", case.to_toml())
        summary = summary | self._requested | {"case": case.model_dump(by_alias=True)}
        write_text(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")


def _gathered(case: Case, *fields: str) -> Case:
    """``case`` with these fields of all cells, gathered on one rank."""
    output = {"fields": list(fields), "window": None, "every": 1, "writer": "gather"}
    return case.model_copy(update={"output": case.output.model_copy(update=output)})


def _keeping(run: xr.Dataset, case: Case, *fields: str) -> xr.Dataset:
    """``run`` of ``case`` with these of its fields alone."""
    dropped = [name for name in ("displacement", "velocity") if name in run and name not in fields]
    return run.drop_vars(dropped).assign_attrs(case=_gathered(case, *fields).to_toml())
