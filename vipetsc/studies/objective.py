"""The runs that a design is judged by: made over teams of ranks, measured, recorded as they come."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, Model, case_id
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.lattice import pass_bands
from vipetsc.parallel import StopRequest, on_root
from vipetsc.spectra.modal_energies import ModalParts
from vipetsc.studies.analysis import analyse
from vipetsc.studies.recorded_runs import Key, RecordedRuns, run_in_memory

ANALYSED = {"ibtet": ("bands", "ibtet"), "entropy": ("entropy", "entropy/energy_weighted")}  # of ``analyse``


class ObjectiveRuns:
    """Makes ``recorded`` runs of designs in ``folder`` on the ranks of ``comm``, and tells what they came to.

    The record of a run by the hash of its case: its ``values``, or why it failed (``reason``).
    All ranks must make one.
    """

    def __init__(self, plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> None:
        self.plan = plan
        self.recorded = RecordedRuns("optimum", folder, comm, stop, plan.options.ranks)

    def make(self, runs: Iterable[Case]) -> None:
        """Make those ``runs`` that are not known; all ranks must call it. Raises StoppedError on all."""
        cases: dict[Key, Case] = {case_id(case): case for case in runs}
        self.recorded.make(cases, lambda name: {"values": self._values(cases[name])}, failures=True)

    def _values(self, case: Case) -> dict[str, Any]:
        """What is measured of a run, by its whole team."""
        data, result = run_in_memory(case, self.recorded.team, self.recorded.stop)
        objectives = self.plan.options.objective
        return on_root(self.recorded.team, lambda: measured(data, result.statistics, objectives))

    def losses(self, design: Case) -> tuple[list[float], str]:
        """How far a ``design`` whose runs were made is from each goal, small is good; NaN if one failed, and why."""
        options, known = self.plan.options, self.recorded.known
        records = {key: known[case_id(run)] for key, run in self.runs(design).items()}
        failed = [f"{key[0]:g} N: {record['reason']}" for key, record in records.items() if "reason" in record]
        losses = []
        for objective in options.objective:
            sign, over = (-1 if objective.goal == "maximise" else 1), objective.amplitudes or [self.amplitude]
            if failed:
                losses.append(np.nan)
                continue
            of = [
                [r["values"][objective.name] for (a, _), r in records.items() if a == amplitude] for amplitude in over
            ]
            means = [sign * float(np.mean(values)) for values in of]
            losses.append(max(means) if objective.over == "worst" else float(np.mean(means)))
        return losses, "; ".join(failed[:1])

    def values(self, run: Case) -> dict[str, Any]:
        """What was measured of a ``run`` that is known; nothing of one that failed."""
        return dict(self.recorded.known[case_id(run)].get("values", {}))

    @property
    def amplitude(self) -> float:
        """That of the case in N."""
        return float(self.plan.base.drive.amplitude)

    def runs(self, design: Case) -> dict[tuple[float, int], Case]:
        """The runs of a ``design`` by their amplitude in N and the number of what scatters; raises CaseError."""
        amplitudes = dict.fromkeys(a for o in self.plan.options.objective for a in o.amplitudes or [self.amplitude])
        pairs = itertools.product(amplitudes, range(self.plan.options.samples))
        return {(amplitude, lot): self.plan.run(design, amplitude, lot) for amplitude, lot in pairs}


def measured(run: xr.Dataset, statistics: dict[str, Any], objectives: Sequence[ObjectiveTable]) -> dict[str, Any]:
    """What the ``objectives`` ask of a ``run``, by their names, and what is always told.

    ``upper_share_at_end``, ``bands`` (pass band): energy at the end over the work; ``transmitted``: that beyond the
    last site; ``dissipated``, ``episodes``, ``ibtet`` and ``entropy`` where they are asked for.
    """
    model, work = Case.of(run).model(), float(run["energy/work"][-1])
    state = [run[name].values[-1:] for name in ("displacement", "velocity")]
    modal, bands = ModalParts.of(model.chain), pass_bands(model.chain.cell)
    energy, frequency = 0.5 * np.abs(modal.modes.amplitudes(*state)[0]) ** 2 / work, modal.modes.frequency
    above, names = modal.parts.above(model.drive.frequency), [band.number for band in bands]
    inside = {name: modal.part == [name in part for part in modal.parts.bands].index(True) for name in names}
    values: dict[str, Any] = {"episodes": statistics["episodes"], "dissipated": statistics["dissipated"] / work}
    values["bands"] = [float(energy[inside[name]].sum()) for name in names]
    values["upper_share_at_end"] = float(energy[above[modal.part]].sum())
    values["transmitted"] = _beyond(model, *state) / work
    asked = {o.measure: ANALYSED[o.measure] for o in objectives if o.measure in ANALYSED}
    analysis = analyse(run, {measure for measure, _ in asked.values()}) if asked else {}
    values |= {name: float(analysis[variable]) for name, (_, variable) in asked.items()}
    for objective in objectives:
        if objective.band:
            low, high = objective.part or (0.0, np.inf)
            within = inside[objective.band] & (frequency >= low) & (frequency < high)
            values[objective.name] = float(energy[within].sum())
    return values


def _beyond(model: Model, displacement: np.ndarray, velocity: np.ndarray) -> float:
    """Energy in J of the cells beyond the site that is farthest from the drive; of springs at the border about half."""
    chain, sites = model.chain, np.array(model.chain.sites)
    far = sites[np.argmax(np.abs(sites - model.drive_cell))]
    beyond = np.arange(chain.cells) > far if far >= model.drive_cell else np.arange(chain.cells) < far
    u, v = displacement.ravel(), velocity.ravel()
    energy = u * (chain.stiffness_matrix() @ u) + chain.masses() * v**2
    return 0.5 * float(energy.reshape(chain.cells, -1)[beyond].sum())
