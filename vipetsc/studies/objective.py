"""The runs that evaluate a design: simulated by teams of ranks, measured, and recorded as they end.

A design has a run for each amplitude that an objective or a constraint names and each sample of disorder, or its
frequency responses for each sample. A measure at an amplitude, or of a curve, is the mean over the samples. The loss of
an objective is the mean or the worst of these, with the sign changed if it is to be maximised.
"""

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, Model, case_id
from vipetsc.case.amplitude import amplitude_of
from vipetsc.case.nfrc import NfrcCase, ResponseMeasure
from vipetsc.case.optimise import MeasuredTable, OptimiseCase
from vipetsc.endings import Ending
from vipetsc.io.records import Record
from vipetsc.lattice import pass_bands
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.responses import ISOLA
from vipetsc.modes.branches.sweeps import measure, parameter_values
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.spectra.modal_energies import ModalParts
from vipetsc.spectra.responses import CurvePart, largest_response, widest_gap
from vipetsc.studies.analysis import analyse
from vipetsc.studies.recorded_runs import Key, RecordedRuns

OF_A_BAND = "band_share"
Condition = tuple[float | None, int]  # an amplitude, or None for the frequency responses, and the number of the sample
# Names in searches of measures that have another one in results.
RENAMED = {"entropy": "entropy/energy_weighted"}
# Relative. The last point of a complete curve lies on the upper end of its range, but for the tolerance of Newton's
# method.
ROUNDING = 1e-9


class Judgement(NamedTuple):
    """Judgement of a design: ``losses`` (objective), small for a good one, NaN if a run failed, with the ``reason``.

    ``constraints`` are the values of what is constrained, ``excess`` sums by how much they are outside their bounds.
    """

    losses: list[float]
    constraints: list[float]
    excess: float = 0.0
    reason: str = ""


class ObjectiveRuns:
    """Computes ``recorded`` runs of designs in ``folder`` on the ranks of ``comm``, and judges designs by them.

    A run, or the frequency responses of a design, has a record under the hash of its case: the measured ``values``, or
    the ``reason`` why it failed. All ranks must construct one.
    """

    def __init__(self, plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> None:
        self.plan = plan
        self.recorded = RecordedRuns("optimum-runs", folder, comm, stop, ranks=plan.options.ranks).read()

    def runs(self, design: Case) -> dict[Condition, Case]:
        """Return runs of a ``design`` by amplitude and number of the disorder's sample, and its frequency responses.

        Raises CaseError.
        """
        # A dictionary names each amplitude once and keeps the order, which is the same on all ranks.
        conditions: dict[float | None, None] = {}
        for table in self.plan.options.measured:
            conditions |= dict.fromkeys(_conditions(table, design))

        runs: dict[Condition, Case] = {}
        for condition, sample in itertools.product(conditions, range(self.plan.options.samples)):
            if condition is None:
                runs[condition, sample] = self.plan.responses(design, sample)
            else:
                runs[condition, sample] = self.plan.run(design, condition, sample)
        return runs

    def make(self, runs: Iterable[Case]) -> None:
        """Simulate those ``runs`` that have no record; all ranks must call it. Raises StoppedError on all."""
        cases: dict[Key, Case] = {case_id(case): case for case in runs}
        # A design that fails is a bad one, and the search goes on.
        self.recorded.make(cases, lambda name: self._record(cases[name]), allow_failures=True)

    def _record(self, case: Case) -> Record:
        """Return the record of measured values of a run, or of frequency responses, which its whole team computes."""
        if isinstance(case, NfrcCase):
            return measured_responses(case, self._tables(case), self.recorded.team, self.recorded.stop)
        data, result = self.recorded.run_in_memory(case)
        return {"values": on_root(self.recorded.team, lambda: measured(data, result.statistics, self._tables(case)))}

    def _tables(self, case: Case) -> list[MeasuredTable]:
        """Return the objectives and constraints that are measured of a run or frequency responses of a ``case``."""
        is_of_responses = isinstance(case, NfrcCase)
        return [table for table in self.plan.options.measured if table.is_of_responses == is_of_responses]

    def judge(self, design: Case) -> Judgement:
        """Return the judgement of a ``design`` whose runs are recorded."""
        options = self.plan.options
        constraints = options.constraint or []
        records: dict[Condition, Record] = {}
        for (condition, sample), run in self.runs(design).items():
            records[condition, sample] = self.recorded.records[case_id(run)]
            reason = self._failure(run)
            if reason:
                if condition is not None:
                    reason = f"{condition:g} {self.plan.amplitude_unit}: {reason}"
                return Judgement(
                    losses=[np.nan] * len(options.objective), constraints=[np.nan] * len(constraints), reason=reason
                )

        losses = []
        for objective in options.objective:
            by_amplitude = _means(objective, design, records)
            if objective.goal == "maximise":
                by_amplitude = [-mean for mean in by_amplitude]
            if objective.over == "worst":
                # Losses are small for good designs, so the worst is the largest.
                losses.append(max(by_amplitude))
            else:
                losses.append(float(np.mean(by_amplitude)))

        bounded = []
        excess = 0.0
        for constraint in constraints:
            means = _means(constraint, design, records)
            if constraint.over == "worst":
                # The worst is the one that is farthest outside the bounds.
                value = max(means, key=constraint.excess)
            else:
                value = float(np.mean(means))
            bounded.append(value)
            excess += constraint.excess(value)
        return Judgement(losses, bounded, excess)

    def _failure(self, run: Case) -> str:
        """Return the reason why a ``run`` that has a record cannot be used; empty if it can."""
        record = self.recorded.records[case_id(run)]
        if "reason" in record:
            return str(record["reason"])
        values = record["values"]
        for table in self._tables(run):
            if np.isnan(values[table.name]).any():
                return "; ".join([f"{table.name} has no value", *values.get("warnings", [])])
        return ""

    def values(self, run: Case) -> dict[str, Any]:
        """Return values measured of a ``run`` that has a record; none of one that failed."""
        return dict(self.recorded.records[case_id(run)].get("values", {}))

    def curves(self, responses: NfrcCase) -> list[dict[str, Any]]:
        """Return the curves of frequency ``responses`` that have a record, as ``measured_responses`` returns them."""
        return list(self.recorded.records[case_id(responses)].get("curves", []))


def _conditions(table: MeasuredTable, design: Case) -> list[float | None]:
    """Return the amplitudes at which a ``design`` is measured for an objective or a constraint; None for responses."""
    if table.is_of_responses:
        return [None]
    return [*table.amplitudes] or [amplitude_of(design)]


def _means(table: MeasuredTable, design: Case, records: Mapping[Condition, Record]) -> list[float]:
    """Return the mean over samples of a measure, at each amplitude or curve; ``records`` by condition and sample."""
    means: list[float] = []
    for condition in _conditions(table, design):
        samples = [row["values"][table.name] for (at, _), row in records.items() if at == condition]
        means += np.atleast_1d(np.mean(samples, axis=0)).tolist()
    return means


def measured(run: xr.Dataset, statistics: dict[str, Any], tables: Sequence[MeasuredTable]) -> dict[str, Any]:
    """Return values of a ``run`` that objectives and constraints, the ``tables``, need, by name, and some of all runs.

    The values of all runs are fractions of the energy that the lattice received, the drive's work and the energy of the
    motion at t = 0: ``bands`` (pass band), ``upper_share_at_end`` (bands above the driven one) and ``transmitted``
    (cells beyond the last site) at the end, and ``dissipated`` in all; and the number of contact ``episodes``.
    """
    model = Case.of(run).model()
    # The ledger counts the energy of the motion at t = 0 as work.
    work = float(run["energy/work"][-1])
    if not work > 0:
        raise RuntimeError(f"the lattice received {work:.3g} J: no energy of which a fraction could be measured")
    u = run["displacement"].values[-1:]
    v = run["velocity"].values[-1:]
    # All of these are measured whatever is asked for: the pictures compare designs by them.
    values: dict[str, Any] = {
        "episodes": statistics["episodes"],
        "dissipated": statistics["dissipated"] / work,
        **_of_bands(model, u, v, work, tables),
        "transmitted": _energy_beyond(model, u, v) / work,
    }
    return values | _analysed(
        run, [table for table in tables if table.measure not in values and table.measure != OF_A_BAND]
    )


def _of_bands(
    model: Model, u: np.ndarray, v: np.ndarray, work: float, tables: Sequence[MeasuredTable]
) -> dict[str, Any]:
    """Return energies of the bands over the ``work`` in J in the state ``u``, ``v`` (1, cell, dof) in m and m/s.

    ``bands`` (pass band), ``upper_share_at_end``, and those parts of a band that ``tables`` ask for, by their names;
    NaN where contacts alone join the cells, so that there are no bands.
    """
    of_a_band = [table for table in tables if table.measure == OF_A_BAND]
    if not model.chain.cell.joins_cells:
        values: dict[str, Any] = {"bands": [np.nan] * model.chain.cell.dofs, "upper_share_at_end": np.nan}
        return values | {table.name: np.nan for table in of_a_band}

    # By modes rather than filters: the energies of an undamped lattice's modes are constant after the last contact,
    # so that one sample suffices.
    modal = ModalParts.of(model.chain)
    energy = 0.5 * np.abs(modal.modes.amplitudes(u, v)[0]) ** 2 / work
    frequency = modal.modes.frequency
    above = modal.parts.above(model.drive.frequency)

    # Modes (mode) of each pass band; bands that overlap are one part.
    inside: dict[int, np.ndarray] = {}
    for band in pass_bands(model.chain.cell):
        holds_band = [band.number in bands for bands in modal.parts.bands]
        inside[band.number] = modal.part == holds_band.index(True)
    values = {
        "bands": [float(energy[modes].sum()) for modes in inside.values()],
        "upper_share_at_end": float(energy[above[modal.part]].sum()),
    }
    for table in of_a_band:
        if table.band:
            low, high = table.part or (0.0, np.inf)
            within = inside[table.band] & (frequency >= low) & (frequency < high)
            values[table.name] = float(energy[within].sum())
    return values


def _analysed(run: xr.Dataset, tables: Sequence[MeasuredTable]) -> dict[str, Any]:
    """Return values of those ``tables`` that ask for a measure of the registry, by their names, and ``warnings``."""
    if not tables:
        return {}
    names = {table.name: RENAMED.get(table.measure, table.measure) for table in tables}
    analysis = analyse(run, {*names.values()})

    values: dict[str, Any] = {}
    for table in tables:
        # What the run cannot give is left out of its analysis.
        value = analysis.get(names[table.name])
        if value is None:
            values[table.name] = np.nan
        elif table.band:
            values[table.name] = float(value[_part_of(value.attrs["parts"], table.band)])
        else:
            values[table.name] = float(value)
    warnings = json.loads(analysis.attrs["warnings"])
    if warnings:
        values["warnings"] = warnings
    return values


def _part_of(parts: Sequence[str], band: int) -> int:
    """Return the number (from 0) of that of the ``parts``, named as ``spectra.Parts`` does, that holds a ``band``."""
    for number, name in enumerate(parts):
        if name.startswith("band ") and str(band) in name.removeprefix("band ").split("+"):
            return number
    raise ValueError(f"no part holds band {band}")


def _energy_beyond(model: Model, displacement: np.ndarray, velocity: np.ndarray) -> float:
    """Return the energy in J of the cells beyond the site that is farthest from the drive.

    Springs between these cells count in full; the spring k at the boundary counts as k u_b (u_b - u_a)/2, u_b beyond
    it. NaN without a site, and on a ring, where both sides of a site are on the way to it.
    """
    chain = model.chain
    if not chain.sites or chain.ends == "periodic":
        return np.nan
    sites = chain.sites.cells
    farthest = sites[np.argmax(np.abs(sites - model.drive_cell))]
    cells = np.arange(chain.cells)
    beyond = cells > farthest
    if farthest < model.drive_cell:
        beyond = cells < farthest

    u = displacement.ravel()
    v = velocity.ravel()
    # Twice the energy of each mass: its own of kinetic energy, and k u (u - u') of each spring to a mass u'.
    energy = u * (chain.stiffness_matrix() @ u) + chain.masses() * v**2
    return 0.5 * float(energy.reshape(chain.cells, -1)[beyond].sum())


def measured_responses(
    case: NfrcCase, tables: Sequence[MeasuredTable], comm: MPI.Comm, stop: StopRequest
) -> dict[str, Any]:
    """Follow the curves of ``case`` on the ranks of ``comm``, each on one, and measure them; returns a record.

    ``values`` holds what each of the ``tables`` asks for, by its name, as a list over the curves. ``curves`` is a list
    of the curves and their isolated parts, each with its ``name`` and with lists over its points: ``parameter``,
    ``unstable`` (number of perturbations that grow) and ``values`` by the tables' names. Collective. Raises on all
    ranks StoppedError if a curve was stopped, RuntimeError if one does not reach the end of its range.
    """
    branches = follow_all(case, None, comm, stop=stop)
    return on_root(comm, lambda: _record(case, branches, tables))


def _record(case: NfrcCase, branches: Sequence[Branch[Any]], tables: Sequence[MeasuredTable]) -> dict[str, Any]:
    """Return the record of ``measured_responses`` from the ``branches`` of a case; raises as it does."""
    for branch in branches:
        if branch.ended.ending is Ending.STOPPED:
            raise StoppedError(branch.ended.sentence)
        reason = _why_incomplete(case, branch)
        if reason:
            raise RuntimeError(f"curve {branch.name}: {reason}")

    measures = case.measures()
    values: dict[str, list[float]] = {}
    for table in tables:
        response = measures[str(table.measure)]
        low, high = table.part or case.nfrc.range
        over_curves: list[float] = []
        for curve in case.every_curve():
            # Isolated states are as possible as those of the curve near which they lie.
            parts = [_part(b, response) for b in branches if b.name.partition(ISOLA)[0] == curve.name]
            if table.below:
                over_curves.append(widest_gap(parts, table.below, low, high))
            else:
                over_curves.append(largest_response(parts, low, high))
        values[table.name] = over_curves

    curves: list[dict[str, Any]] = []
    for branch in branches:
        curves.append({
            "name": branch.name,
            "unstable": measure(branch, "unstable").tolist(),
            "values": {table.name: _values(branch, measures[str(table.measure)]).tolist() for table in tables},
            "parameter": parameter_values(branch).tolist(),
        })  # fmt: skip
    return {"values": values, "curves": curves}


def _why_incomplete(case: NfrcCase, branch: Branch[Any]) -> str:
    """Return why a curve has no states in a part of its range; empty if it has."""
    if not branch.complete:
        return branch.ended.sentence
    # An isolated part covers what it covers.
    if ISOLA in branch.name:
        return ""
    high = case.nfrc.range[1]
    last = parameter_values(branch)[-1]
    if last < high - ROUNDING * abs(high):
        return f"turned back and {branch.ended.sentence}, without states up to {high:g}"
    return ""


def _values(branch: Branch[Any], response: ResponseMeasure) -> np.ndarray:
    """Return the values (point,) of a ``response`` in the states of a curve: its member's, or the largest of all."""
    values = measure(branch, response.quantity).reshape(len(branch.points), -1)
    if response.member is None:
        return np.asarray(values.max(axis=1))
    return np.asarray(values[:, response.member])


def _part(branch: Branch[Any], response: ResponseMeasure) -> CurvePart:
    """Return the values of a ``response`` along a curve, by which they are interpolated."""
    # With the length along the curve, which rises, while the parameter turns back at folds.
    steps = np.linalg.norm(np.diff(branch.column("xi"), axis=0), axis=1)
    return CurvePart(
        parameter=parameter_values(branch),
        values=_values(branch, response),
        length=np.append(0.0, np.cumsum(steps)),
        is_regular=branch.is_kind("regular"),
    )
