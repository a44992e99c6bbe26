"""Trajectories against independent integrations, exact relations and symmetries."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import StopAt, assert_same_bits, datasets, run_of, small_case
from vipetsc.dynamics import simulate


def relative(difference: np.ndarray, whole: np.ndarray) -> float:
    """The Euclidean norm of a ``difference``, divided by that of the ``whole``."""
    return float(np.linalg.norm(difference) / np.linalg.norm(whole))


def test_tolerance_keeps_its_promise():
    """A hundredth of the tolerance lowers the error by ten or more; 1e-10 leaves less than 1e-6."""
    velocity = {rtol: run_of(small_case(time={"rtol": rtol}))["velocity"].values for rtol in (1e-8, 1e-10, 1e-12)}
    coarse = relative(velocity[1e-8] - velocity[1e-12], velocity[1e-12])
    fine = relative(velocity[1e-10] - velocity[1e-12], velocity[1e-12])

    assert coarse < 1e-4
    assert fine < 1e-6
    assert fine < coarse / 10


@pytest.fixture(scope="module")
def exact():
    """Velocities of the small case by the default method, at a tolerance a hundred times lower than the others'."""
    return run_of(small_case(time={"end": 0.04, "rtol": 1e-11}))["velocity"].values


# The third-order pair would need very many steps at 1e-9.
@pytest.mark.parametrize(("method", "rtol"), [("3bs", 1e-6), ("7vr", 1e-9)])
def test_every_method_samples_exactly(folder, exact, method, rtol):
    """Every Runge-Kutta method ends steps on samples, where its error is that of its steps alone.

    Dense output between steps would add errors. A run that is stopped and resumed has the same bits.
    """
    case = small_case(time={"end": 0.04, "method": method, "rtol": rtol})

    simulate(case, folder / "straight")

    straight = datasets(folder / "straight" / "run.h5")
    assert relative(straight["velocity"] - exact, exact) < 1e4 * rtol

    # Some pairs use the last stage of a step as the first of the next one, which must not depend on a stop.
    assert simulate(case, folder / "stopped", stop=StopAt(150)).resumable
    assert simulate(case, folder / "stopped").complete
    assert_same_bits(straight, datasets(folder / "stopped" / "run.h5"))


def test_fixed_steps_converge_with_the_order_of_the_method(petsc_options):
    """With fixed steps (-ts_adapt_type none -ts_dt H) halving H divides the error of the method 3bs by about 2^3.

    The run has bilinear contacts.
    """
    exact = run_of(small_case(contacts={"law": "bilinear"}, time={"rtol": 1e-13, "end": 0.022}))
    velocity = exact["velocity"].values

    errors = []
    for step in (4e-6, 2e-6, 1e-6):
        petsc_options(ts_rk_type="3bs", ts_adapt_type="none", ts_dt=step)
        run = run_of(small_case(contacts={"law": "bilinear"}, time={"end": 0.022}))
        assert len(run["impacts/onset"]) == len(exact["impacts/onset"]) > 0
        errors.append(relative(run["velocity"].values - velocity, velocity))

    # The measured order is a little below 3, as changes of contact are located to a tolerance only.
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(orders > 2.5), orders
