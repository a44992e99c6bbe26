"""Frequency responses of designs: their curves, followed in memory, and what a search measures of them."""

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case.nfrc import NfrcCase, ResponseMeasure
from vipetsc.case.optimise import MeasuredTable
from vipetsc.endings import Ending
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.responses import ISOLA
from vipetsc.modes.branches.sweeps import measure, parameter_values
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.spectra.responses import CurvePart, largest_response, widest_gap

# Relative. The last point of a complete curve lies on the upper end of its range, but for the tolerance of Newton's
# method.
ROUNDING = 1e-9


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
