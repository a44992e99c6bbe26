"""Lattices with a few nonlinear springs in the propagator: agreement with ``ts``, the energy ledger, resumed runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import simulated, small_case
from vipetsc.case import Case
from vipetsc.dynamics.plan import choose_engine
from vipetsc.dynamics.propagator.groups import contact_dofs, group_dofs
from vipetsc.dynamics.propagator.step_choice import refusal, step_series

pytestmark = pytest.mark.parallel(1)

# The spring of the last cell, 24, leads to the first cell on a ring, and to the wall of a fixed end.
SPRINGS: dict[str, Any] = {
    "springs[1].cubic": {"cells": [11, 24], "value": 3e11},
    "springs[4].quadratic": {"cells": [5, 13], "value": 4e4},
}


def sprung(lattice: dict[str, Any] | None = None, **sections: Any) -> Case:
    """The small lattice with four nonlinear springs and no contacts, under a burst."""
    plain = {"contacts": {"sites": 0}, "drive": {"amplitude": 24.0}, "time": {"end": 0.03, "engine": "propagator"}}
    return small_case(**plain | {"lattice": {"profiles": SPRINGS} | (lattice or {})} | sections)


def motion(case: Case, engine: str) -> np.ndarray:
    """Displacements (time, cell, dof) in m by an ``engine`` at a tolerance of 1e-11; asserts that the ledger closes."""
    run, result = simulated(case.varied(time={"engine": engine, "rtol": 1e-11}))
    assert result.statistics["engine"] == engine
    assert result.statistics["ledger_error"] < 1e-10
    return run["displacement"].values


def difference(case: Case) -> float:
    """The largest difference between the displacements by the two engines, divided by the largest displacement."""
    exact = motion(case, "propagator")
    return float(np.abs(exact - motion(case, "ts")).max() / np.abs(exact).max())


@pytest.mark.parametrize("quadratic", [0.0, 2e6])
def test_the_left_wall_has_the_spring_of_the_reference_cell(quadratic):
    """The spring to the left wall is that of the reference cell, nonlinear even if profiles make all others linear.

    Its force has the sign of its own elongation, which a displacement of the first mass lengthens.
    """
    springs = [
        {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True, "cubic": 1e10, "quadratic": quadratic},
        {"start": 1, "end": 2, "stiffness": 5e3},
    ]
    none = {f"springs[1].{term}": [0.0] * 24 for term in ("quadratic", "cubic")}
    cell = {"preset": None, "cell": {"masses": [4e-3, 2e-3], "springs": springs}}
    case = sprung(lattice=cell | {"profiles": none}, drive={"amplitude": 8.0, "cell": 2, "frequency": 900.0})
    dofs = contact_dofs(case.model())
    assert dofs["form"].tolist() == [[[1, 0]], [[1, 0]]]
    assert dofs["cell"].tolist() == [0, 1]
    assert difference(case) < 1e-9


def test_a_spring_that_is_hardly_stretched_is_linear():
    """A nonlinear spring with a tiny elongation gives the bits of a linear one, without additional substeps.

    The nonlinear part of its force is below rounding.
    """
    weak = {"drive": {"amplitude": 1e-8}}
    nonlinear, result = simulated(
        sprung(lattice={"profiles": {"springs[1].cubic": SPRINGS["springs[1].cubic"]}}, **weak)
    )
    linear, plain = simulated(sprung(lattice={"profiles": None}, **weak))
    assert nonlinear["displacement"].values.tobytes() == linear["displacement"].values.tobytes()
    assert result.statistics["substeps"] == plain.statistics["substeps"]


def test_elongations_are_degrees_of_freedom_behind_the_sites():
    """Elongations of nonlinear springs are numbered after the sites and before the drive."""
    model = sprung(contacts={"sites": [12]}).model()
    dofs = contact_dofs(model)
    assert dofs["cell"].tolist() == [11, 4, 10, 12, 23, 0]
    assert dofs["last"].tolist() == [11, 4, 11, 12, 23, 0]
    assert dofs["form"][2].tolist() == [[0, 0, 0, -1], [1, 0, 0, 0]]
    assert dofs["form"][4].tolist() == [[0, 0, 0, -1], [0, 0, 0, 0]]
    groups = group_dofs(model, 2)
    assert np.split(groups.numbers, groups.first[1:-1])[-2].tolist() == [0, 2, 3]
    # Below the elongation z with |c| z^2 = 2^-53 k the cubic force is less than the rounding error of k z.
    assert dofs["clearance"][2] == pytest.approx(np.sqrt(2.0**-53 * 2e4 / 3e11))


def test_many_springs_go_to_ts():
    """A lattice with nonlinear springs in every cell is run by ``ts``, with the reason; one with few is not."""
    everywhere = sprung(lattice={"profiles": {"springs[1].cubic": [3e11] * 24}}).model()
    reason = refusal(everywhere)
    assert reason is not None
    assert "24 nonlinear springs" in reason
    assert "times as much as ts" in reason
    # The springs are too many for any step, so that no step is computed.
    step_series.cache_clear()
    long = sprung(lattice={"cells": 2000, "profiles": {"springs[1].cubic": [3e11] * 2000}})
    chosen = choose_engine(long, long.model())
    assert chosen.name == "ts"
    assert "2000 nonlinear springs" in (chosen.refused or "")
    assert step_series.cache_info().currsize == 0

    few = {"springs[1].cubic": {"cells": list(range(100, 125)), "value": 3e11}}
    assert refusal(sprung(lattice={"cells": 2000, "profiles": few}).model()) is None
