"""PETSc's Newton method: exceptions of the equations reach the caller, and the solver can be used afterwards."""

import numpy as np
import pytest

from vipetsc.modes.newton import DenseNewton
from vipetsc.modes.problem import FlowError


class Circle:
    """The equation x^2 + y^2 = 1; the evaluation of number ``fails_at`` raises ``error`` and must be the last one."""

    def __init__(self, fails_at: dict[str, int] | None = None, error: BaseException | None = None) -> None:
        self.error = error
        self.left = {"residual": 99, "jacobian": 99} | (fails_at or {})
        self.failed = False

    def _count(self, name: str) -> None:
        assert not self.failed, "evaluated after it has failed"
        self.left[name] -= 1
        if self.left[name] < 0:
            self.failed = True
            raise self.error

    def residual(self, xi):
        self._count("residual")
        return np.array([xi @ xi - 1])

    def jacobian(self, xi):
        self._count("jacobian")
        return 2 * xi[None]


ROW = np.array([1.0, -1.0])
GUESS = np.array([0.8, 0.5])

NAMES = ["residual", "jacobian"]


def meets_the_circle(newton) -> bool:
    attempt = newton.solve(Circle(), GUESS, ROW, 0.0, 1e-12)
    return attempt.converged and np.allclose(attempt.xi, np.sqrt(0.5), atol=1e-10)


@pytest.mark.parametrize("error", [ZeroDivisionError("no such orbit"), KeyboardInterrupt("stop")])
def test_what_the_equations_raise_comes_out(error):
    """An exception of the equations is raised by ``solve`` as the same object, and the solver works afterwards."""
    newton = DenseNewton(2, 20)
    for name in NAMES:
        for evaluations in (0, 1):
            with pytest.raises(type(error)) as caught:
                newton.solve(Circle({name: evaluations}, error), GUESS, ROW, 0.0, 1e-12)
            assert caught.value is error
            assert meets_the_circle(newton)


def test_leaving_the_domain_is_an_attempt_that_failed():
    """A FlowError ends the attempt at its guess, with its text as the reason, and the solver works afterwards."""
    newton = DenseNewton(2, 20)
    for name in NAMES:
        for evaluations in (0, 1):
            attempt = newton.solve(Circle({name: evaluations}, FlowError("no flow")), GUESS, ROW, 0.0, 1e-12)
            assert not attempt.converged
            assert attempt.left_domain
            assert attempt.reason == "no flow"
            assert np.isfinite(attempt.history).all()
            assert np.array_equal(attempt.xi, GUESS)
            assert meets_the_circle(newton)


def test_an_error_that_petsc_makes_of_it_does_not_hide_it(petsc_options):
    """An exception of the equations is raised, not the PETSc error that follows from it."""
    petsc_options(nnm_snes_error_if_not_converged=True)
    newton = DenseNewton(2, 20)
    with pytest.raises(ZeroDivisionError):
        newton.solve(Circle({"residual": 1}, ZeroDivisionError("no such orbit")), GUESS, ROW, 0.0, 1e-12)


@pytest.mark.parametrize("residual", [np.nan, np.inf])
def test_a_residual_that_is_not_finite_ends_the_attempt(residual):
    """A residual of NaN or infinity ends the attempt without convergence."""
    newton = DenseNewton(2, 20)
    # Most versions of PETSc check the residual themselves before they call the convergence test.
    assert newton._test(newton._snes, 1, (0.8, 0.1, residual)) < 0

    equations = Circle()
    equations.residual = lambda xi: np.array([residual])
    attempt = newton.solve(equations, GUESS, ROW, 0.0, 1e-12)
    assert not attempt.converged
    assert "nan" in attempt.reason
    assert meets_the_circle(newton)
