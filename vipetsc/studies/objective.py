"""The runs by which a design is judged: simulated by teams of ranks, measured, and recorded as they end."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, Model, case_id
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.lattice import pass_bands
from vipetsc.parallel import StopRequest, on_root
from vipetsc.spectra.modal_energies import ModalParts
from vipetsc.studies.analysis import analyse
from vipetsc.studies.recorded_runs import Key, RecordedRuns


class Analysed(NamedTuple):
    """A measure that ``analyse`` is asked for, and the variable of its result that is the objective."""

    measure: str
    variable: str


ANALYSED = {"ibtet": Analysed("bands", "ibtet"), "entropy": Analysed("entropy", "entropy/energy_weighted")}


class ObjectiveRuns:
    """Computes ``recorded`` runs of designs in ``folder`` on the ranks of ``comm``, and judges designs by them.

    The record of a run by the hash of its case: its ``values``, or why it failed (``reason``).
    All ranks must construct one.
    """

    def __init__(self, plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> None:
        self.plan = plan
        self.recorded = RecordedRuns("optimum-runs", folder, comm, stop, plan.options.ranks).read()

    @property
    def amplitude(self) -> float:
        """Amplitude in N of the case to begin with."""
        return float(self.plan.base.drive.amplitude)

    def runs(self, design: Case) -> dict[tuple[float, int], Case]:
        """The runs of a ``design`` by amplitude in N and number of the disorder's sample; raises CaseError."""
        # A dictionary names each amplitude once and keeps the order, which is the same on all ranks.
        amplitudes: dict[float, None] = {}
        for objective in self.plan.options.objective:
            amplitudes |= dict.fromkeys(self._amplitudes(objective))
        pairs = itertools.product(amplitudes, range(self.plan.options.samples))
        return {(amplitude, sample): self.plan.run(design, amplitude, sample) for amplitude, sample in pairs}

    def _amplitudes(self, objective: ObjectiveTable) -> list[float]:
        """Amplitudes in N that an ``objective`` is measured at."""
        return objective.amplitudes or [self.amplitude]

    def make(self, runs: Iterable[Case]) -> None:
        """Simulate those ``runs`` that have no record; all ranks must call it. Raises StoppedError on all."""
        cases: dict[Key, Case] = {case_id(case): case for case in runs}
        # With failures: a design that fails is a bad one, and the search goes on.
        self.recorded.make(cases, lambda name: {"values": self._measure(cases[name])}, failures=True)

    def _measure(self, case: Case) -> dict[str, Any]:
        """Values measured of a run, by its whole team."""
        data, result = self.recorded.run_in_memory(case)
        objectives = self.plan.options.objective
        return on_root(self.recorded.team, lambda: measured(data, result.statistics, objectives))

    def losses(self, design: Case) -> tuple[list[float], str]:
        """Losses of a ``design`` whose runs are recorded, small for a good one; NaN if a run failed, and the reason."""
        objectives = self.plan.options.objective
        records = {key: self.recorded.records[case_id(run)] for key, run in self.runs(design).items()}
        for (amplitude, _), record in records.items():
            if "reason" in record:
                return [np.nan] * len(objectives), f"{amplitude:g} N: {record['reason']}"

        losses = []
        for objective in objectives:
            sign = -1 if objective.goal == "maximise" else 1
            by_amplitude = []
            for amplitude in self._amplitudes(objective):
                samples = [row["values"][objective.name] for (at, _), row in records.items() if at == amplitude]
                by_amplitude.append(sign * float(np.mean(samples)))
            # Losses are small for good designs, so the worst is the largest.
            worst = objective.over == "worst"
            losses.append(max(by_amplitude) if worst else float(np.mean(by_amplitude)))
        return losses, ""

    def values(self, run: Case) -> dict[str, Any]:
        """Values measured of a ``run`` that has a record; none of one that failed."""
        return dict(self.recorded.records[case_id(run)].get("values", {}))


def measured(run: xr.Dataset, statistics: dict[str, Any], objectives: Sequence[ObjectiveTable]) -> dict[str, Any]:
    """Values of a ``run`` that the ``objectives`` need, by their names, and those that every run has.

    ``upper_share_at_end``, ``bands`` (pass band): energy at the end over the work; ``transmitted``: that beyond the
    last site; ``dissipated``, ``episodes``, ``ibtet`` and ``entropy`` where they are asked for.
    """
    model = Case.of(run).model()
    work = float(run["energy/work"][-1])
    u, v = (run[name].values[-1:] for name in ("displacement", "velocity"))
    modal = ModalParts.of(model.chain)
    energy = 0.5 * np.abs(modal.modes.amplitudes(u, v)[0]) ** 2 / work
    frequency = modal.modes.frequency
    above = modal.parts.above(model.drive.frequency)

    # Modes (mode) of each pass band; bands that overlap are one part.
    inside: dict[int, np.ndarray] = {}
    for band in pass_bands(model.chain.cell):
        holds_band = [band.number in bands for bands in modal.parts.bands]
        inside[band.number] = modal.part == holds_band.index(True)
    # All of these are measured whatever is asked for: the pictures compare designs by them.
    values: dict[str, Any] = {
        "episodes": statistics["episodes"],
        "dissipated": statistics["dissipated"] / work,
        "bands": [float(energy[modes].sum()) for modes in inside.values()],
        "upper_share_at_end": float(energy[above[modal.part]].sum()),
        "transmitted": _energy_beyond(model, u, v) / work,
    }

    asked = {o.measure: ANALYSED[o.measure] for o in objectives if o.measure in ANALYSED}
    if asked:
        analysis = analyse(run, {analysed.measure for analysed in asked.values()})
        for name, analysed in asked.items():
            values[name] = float(analysis[analysed.variable])

    for objective in objectives:
        if objective.band:
            low, high = objective.part or (0.0, np.inf)
            within = inside[objective.band] & (frequency >= low) & (frequency < high)
            values[objective.name] = float(energy[within].sum())
    return values


def _energy_beyond(model: Model, displacement: np.ndarray, velocity: np.ndarray) -> float:
    """Energy in J of the cells beyond the site that is farthest from the drive.

    Springs between these cells count whole. Of one at the cut, of stiffness k, k u_b (u_b - u_a)/2 counts, u_b beyond.
    """
    chain = model.chain
    sites = np.array(chain.sites)
    farthest = sites[np.argmax(np.abs(sites - model.drive_cell))]
    cells = np.arange(chain.cells)
    beyond = cells > farthest if farthest >= model.drive_cell else cells < farthest

    u = displacement.ravel()
    v = velocity.ravel()
    energy = u * (chain.stiffness_matrix() @ u) + chain.masses() * v**2
    return 0.5 * float(energy.reshape(chain.cells, -1)[beyond].sum())
