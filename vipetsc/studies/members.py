"""The runs of a sweep, each in a folder of its own: simulated and measured, or scaled from a linear run."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case import Case, case_id
from vipetsc.case.sweep import SweepTable
from vipetsc.dynamics import simulate
from vipetsc.dynamics.memory import RunMemory
from vipetsc.dynamics.run import describe as describe_run
from vipetsc.io.atomic import atomic_write, write_text
from vipetsc.io.folder import provenance
from vipetsc.io.run_file import ENERGIES, IMPACTS, RunFile
from vipetsc.io.store import Coordinates
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.analysis import FULL, REDUCED, analyse, describe

# The largest w between samples exceeds the sampled envelope by less than this for any burst of a few cycles.
MARGIN = 0.9


class StoppedError(Exception):
    """A member was left because the sweep was asked to stop."""


@dataclass(frozen=True)
class LinearWave:
    """What the linear lattice does under a drive of 1 N, cell by cell.

    ``envelope`` (cell): largest sqrt(w^2 + (w'/Om)^2) in m of the contact pair's relative displacement w.
    ``arrival`` (cell): time in s of the largest host velocity, the paper's t_hat when taken at the first site.
    """

    envelope: np.ndarray
    arrival: np.ndarray

    @classmethod
    def of(cls, run: RunFile) -> LinearWave:
        """Measure a linear run with both fields."""
        cell = run.model.chain.cell
        host, resonator = cell.host, cell.resonator
        displacement, velocity = run.displacement[...], run.velocity[...]
        w = displacement[..., resonator] - displacement[..., host]
        rate = velocity[..., resonator] - velocity[..., host]
        envelope = np.sqrt(np.max(w**2 + (rate / run.model.drive.frequency) ** 2, axis=0))
        return cls(envelope, run.field_time[np.argmax(np.abs(velocity[..., host]), axis=0)])

    @classmethod
    def read(cls, path: Path) -> LinearWave:
        """The wave that ``write`` left."""
        with h5py.File(path) as file:
            return cls(file["envelope"][...], file["arrival"][...])

    def write(self, path: Path) -> None:
        """Leave the wave in ``path``, whole or not at all."""
        with atomic_write(path) as aside, h5py.File(aside, "w") as file:
            coordinates = Coordinates(file)
            coordinates.add("cell", np.arange(1, len(self.envelope) + 1), "1", "cell, counted from 1")
            coordinates.put("envelope", ("cell",), self.envelope, "m", "largest relative displacement at 1 N")
            coordinates.put("arrival", ("cell",), self.arrival, "s", "time of the largest host velocity")

    def reached(self, case: Case) -> np.ndarray:
        """Linear relative displacement over clearance (site) at the amplitude of ``case``."""
        sites = np.asarray(case.contacts.sites, int) - 1
        return abs(case.drive.amplitude) * self.envelope[sites] / np.asarray(case.contacts.clearance or [], float)


def linear_case(case: Case) -> Case:
    """The lattice of ``case`` without contacts under 1 N; cases that differ in those alone share it."""
    table = case.model_dump(by_alias=True, exclude_none=True)
    table["contacts"] = {"sites": 0}
    table["drive"]["amplitude"] = 1.0
    table["output"] = {"stride": case.output.stride}
    return Case.from_table(table | {"name": "linear"})


class Members:
    """Makes members in ``folder``; all ranks of ``team`` work on each together.

    ``<id>/`` holds ``case.toml``, ``run.h5`` (without fields unless the sweep keeps them), ``analysis.h5`` and, last
    of all, ``summary.json``; ``linear/<id>/`` the linear runs.
    """

    def __init__(self, folder: Path, options: SweepTable | None, team: MPI.Comm, stop: StopRequest) -> None:
        self.folder, self.options, self.team, self.stop = folder, options or SweepTable(), team, stop
        options = self.options
        asked = {"entropy": "entropy", "transfer": "bands"}
        reduced = tuple(m for m in REDUCED if m in (asked[name] for name in options.measures))
        self.measures = FULL if options.fields else reduced
        self._wanted = {"measures": sorted(options.measures), "fields": options.fields}

    def linear_folder(self, case: Case) -> Path:
        """Where the linear run of ``case`` belongs."""
        return self.folder / "linear" / case_id(linear_case(case))

    def wave(self, case: Case) -> LinearWave:
        """The linear wave of ``case``, made before."""
        return LinearWave.read(self.linear_folder(case) / "wave.h5")

    def make_linear(self, case: Case) -> None:
        """Simulate the linear run of ``case``; raises StoppedError, or RuntimeError if it does not come out."""
        linear, home = linear_case(case), RunMemory(self.team)
        self._simulate(linear, home)
        if self.team.rank == 0:
            folder = self.linear_folder(case)
            folder.mkdir(parents=True, exist_ok=True)
            with home.run(linear) as run:
                wave = LinearWave.of(run)
            home.save(folder / "run.h5", _keeping(linear, ["velocity"]))
            wave.write(folder / "wave.h5")
        self.team.Barrier()

    def is_complete(self, case: Case) -> bool:
        """Whether the member of ``case`` is there with all that the sweep asks for."""
        summary = self.summary(case)
        return bool(summary.get("complete")) and all(summary.get(k) == v for k, v in self._wanted.items())

    def summary(self, case: Case) -> dict[str, Any]:
        """``summary.json`` of the member of ``case``; empty if there is none."""
        path = self.folder / case_id(case) / "summary.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def make(self, case: Case, wave: LinearWave) -> None:
        """Simulate the member of ``case``, or scale it; raises as ``make_linear``."""
        folder = self.folder / case_id(case)
        if self.options.fields:
            self._make_whole(case, folder, wave)
            return
        kept = _keeping(case, [])
        if np.all(wave.reached(case) < MARGIN):
            on_root(self.team, lambda: self._scale(case, kept, folder, wave))
            return
        home = RunMemory(self.team)
        measured = _keeping(case, ["velocity"])
        about = self._simulate(measured, home)

        def measure() -> None:
            folder.mkdir(exist_ok=True)
            home.save(folder / "run.h5", kept)
            with home.run(measured) as run:
                analyse(run, folder / "analysis.h5", self.measures, self.arrival(case, wave))
            self._finish(folder, case, about)

        on_root(self.team, measure)

    def _make_whole(self, case: Case, folder: Path, wave: LinearWave) -> None:
        def is_begun() -> bool:
            kept = folder / "case.toml"
            if folder.is_dir() and not kept.exists():
                shutil.rmtree(folder)  # killed before it had begun
            return (folder / "parts").is_dir() and kept.read_text(encoding="utf-8") == case.to_toml()

        begun = on_root(self.team, is_begun)
        result = simulate(case, folder, self.team, force=not begun, resume=begun, stop=self.stop)
        self._check(result)

        def measure() -> None:
            analyse(folder / "run.h5", folder / "analysis.h5", self.measures, self.arrival(case, wave))
            self._finish(folder, case, self.summary(case))

        on_root(self.team, measure)

    def _simulate(self, case: Case, home: RunMemory) -> dict[str, Any]:
        result = simulate(case, home, self.team, stop=self.stop)
        self._check(result)
        return provenance(self.team) | {
            "status": result.sentence,
            "complete": True,
            "statistics": result.statistics,
        }

    @staticmethod
    def _check(result: Any) -> None:
        if result.resumable:
            raise StoppedError
        if not result.complete:
            raise RuntimeError(result.sentence)

    def _scale(self, case: Case, kept: Case, folder: Path, wave: LinearWave) -> None:
        """The member from its linear run: fields go with the amplitude, energies with its square."""
        unit = Case.from_table(case.model_dump(by_alias=True, exclude_none=True), ["drive.amplitude=1.0"])
        with RunFile(self.linear_folder(case) / "run.h5") as linear:
            about = json.loads(linear.file.attrs["statistics"])
            about |= {"episodes": 0, "scaled_from": self.linear_folder(case).name}
            part = _linear_part(linear, len(case.contacts.sites))
        # All members with the same first site share these measures, whichever rank needs them first.
        first = _leading_site(case)
        shared = self.linear_folder(case) / f"analysis-{first}-{'-'.join(self._wanted['measures'])}.h5"
        if not shared.exists():
            home = _filled(unit, part, {})
            with home.run(_keeping(unit, ["velocity"])) as run:
                analyse(run, shared, self.measures, self.arrival(case, wave))
        folder.mkdir(exist_ok=True)
        factor = case.drive.amplitude**2
        for name in ENERGIES:
            part[name] = part[name] * factor
        about |= {"work": float(part["work"][-1]), "dissipated": 0.0}
        summary = provenance(self.team) | {"status": "complete: scaled from the linear run", "complete": True}
        summary["statistics"] = about
        _filled(case, part, summary).save(folder / "run.h5", kept)
        with atomic_write(folder / "analysis.h5") as aside:
            aside.write_bytes(shared.read_bytes())
            with h5py.File(aside, "r+") as file:
                describe(file, case, summary["status"])
                file.visititems(lambda _, item: _scale_energy(item, factor))
        self._finish(folder, case, summary)

    @staticmethod
    def arrival(case: Case, wave: LinearWave) -> float | None:
        """The paper's t_hat in s: when ``wave`` is loudest at the first site of ``case``; None without sites."""
        first = _leading_site(case)
        return float(wave.arrival[first - 1]) if first else None

    def _finish(self, folder: Path, case: Case, summary: dict[str, Any]) -> None:
        write_text(folder / "case.toml", case.to_toml())
        summary = summary | self._wanted | {"case": case.model_dump(by_alias=True)}
        write_text(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")


def _keeping(case: Case, fields: list[str]) -> Case:
    """``case`` with these fields of all cells, gathered."""
    output = {"fields": fields, "window": None, "every": 1, "writer": "gather"}
    return case.model_copy(update={"output": case.output.model_copy(update=output)})


def _leading_site(case: Case) -> int:
    """Cell (1-based) of the site nearest to the drive; 0 without sites."""
    return min(case.contacts.sites, key=lambda cell: abs(cell - case.drive.cell), default=0)


def _linear_part(run: RunFile, sites: int) -> dict[str, np.ndarray]:
    """A linear run as a recorder's part, with ``sites`` that never touch."""
    part = {"time": run.time, "field_time": run.field_time, "velocity": run.velocity[...], **run.energies}
    part["dissipated_by_site"] = np.zeros((len(run.time), sites))
    return part | {f"impact_{name}": np.zeros(0, int if name in ("site", "side") else float) for name in IMPACTS}


def _filled(case: Case, part: dict[str, np.ndarray], attributes: dict[str, Any]) -> RunMemory:
    home = RunMemory()
    measured = _keeping(case, ["velocity"])
    home.begin(describe_run(measured, measured.model()), force=False, resume=False)
    home.chunks.append(part)
    home.finish(attributes, None, {})
    return home


def _scale_energy(item: h5py.Dataset | h5py.Group, factor: float) -> None:
    if isinstance(item, h5py.Dataset) and item.attrs.get("units") == "J":
        item[...] = item[...] * factor
