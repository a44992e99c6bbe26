"""Frequency responses of designs: their curves, followed in memory, and what a search measures of them."""

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.objective import MeasuredTable
from vipetsc.case.response_measures import ResponseMeasure, response_measures
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.response_layout import measure, parameter_values
from vipetsc.modes.branches.responses import ISOLA
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.spectra.responses import CurvePart, largest_response, widest_gap

ROUNDING = 1e-9  # relative, of the parameter at the end of a range, where a curve is corrected to its tolerance


def measured_responses(
    case: NfrcCase, tables: Sequence[MeasuredTable], comm: MPI.Comm, stop: StopRequest
) -> dict[str, Any]:
    """The record of the curves of ``case``, each of which one rank of ``comm`` follows. Collective.

    ``values`` are lists over the curves of what the ``tables`` ask for, by their names; ``curves`` are the curves with
    their isolated parts: ``name``, ``parameter``, ``unstable`` and ``values`` by point. Raises on all ranks
    StoppedError if a curve was stopped, RuntimeError if one ended early.
    """
    branches = follow_all(case, None, comm, stop=stop)
    return on_root(comm, lambda: _record(case, branches, tables))


def _record(case: NfrcCase, branches: Sequence[Branch[Any]], tables: Sequence[MeasuredTable]) -> dict[str, Any]:
    """The record of the ``branches`` of a case."""
    for branch in branches:
        if branch.ending.startswith("stopped"):
            raise StoppedError(branch.ending)
        reason = _why_incomplete(case, branch)
        if reason:
            raise RuntimeError(f"curve {branch.name}: {reason}")

    measures = response_measures(case)
    values: dict[str, list[float]] = {}
    for table in tables:
        of = measures[str(table.measure)]
        low, high = table.part or case.nfrc.range
        of_curves: list[float] = []
        for curve in case.every_curve():
            # Isolated states are as possible as those of the curve near which they lie.
            parts = [_part(b, of) for b in branches if b.name.partition(ISOLA)[0] == curve.name]
            if table.below:
                of_curves.append(widest_gap(parts, table.below, low, high))
            else:
                of_curves.append(largest_response(parts, low, high))
        values[table.name] = of_curves

    curves: list[dict[str, Any]] = []
    for branch in branches:
        of_points = {table.name: _values(branch, measures[str(table.measure)]).tolist() for table in tables}
        about = {"name": branch.name, "unstable": measure(branch, "unstable").tolist(), "values": of_points}
        curves.append(about | {"parameter": parameter_values(branch).tolist()})
    return {"values": values, "curves": curves}


def _why_incomplete(case: NfrcCase, branch: Branch[Any]) -> str:
    """Why a curve has no states in a part of its range; empty if it has."""
    if not branch.complete:
        return branch.ending
    if ISOLA in branch.name:
        return ""
    high = case.nfrc.range[1]
    last = parameter_values(branch)[-1]
    if last < high - ROUNDING * abs(high):
        return f"turned back and {branch.ending}, without states up to {high:g}"
    return ""


def _values(branch: Branch[Any], of: ResponseMeasure) -> np.ndarray:
    """The measured values (point,) of the states of a curve."""
    values = measure(branch, of.quantity).reshape(len(branch.points), -1)
    return np.asarray(values.max(axis=1) if of.member is None else values[:, of.member])


def _part(branch: Branch[Any], of: ResponseMeasure) -> CurvePart:
    """The measured values along a curve, over the parameter."""
    # Over the length along the curve, which the parameter need not follow: it turns back at folds.
    steps = np.linalg.norm(np.diff(branch.column("xi"), axis=0), axis=1)
    return CurvePart(
        parameter=parameter_values(branch),
        values=_values(branch, of),
        length=np.append(0.0, np.cumsum(steps)),
        is_regular=branch.is_kind("regular"),
    )
