"""Continuation of a user's own F(x, p): folds, branch points and crossing curves against closed forms."""

import numpy as np
import pytest

import vipetsc
from vipetsc.modes.problem import ContinuationError


def special(curve, kind):
    """Return p and x of the points of a kind."""
    chosen = curve["kind"].values == kind
    return curve["p"].values[chosen], curve["x"].values[chosen]


def coupled(x, p):
    """Return a pitchfork at p = 0 on the curved trunk x = (p^2, -p), in coordinates that mix both unknowns."""
    u = x[0] + x[1]
    trunk = p**2 - p
    return np.array([(u - trunk) * (p - (u - trunk) ** 2), x[1] + p])


@pytest.mark.parametrize("function, size", [(lambda x, p: p * x - x**3, 1), (coupled, 2)])
def test_pitchfork(function, size):
    """The branch point is at p = 0, both halves are x = +-sqrt(p) off the trunk, and stability is exchanged."""
    x0 = [0.0] if size == 1 else [1.0, 1.0]
    trunk, *halves = vipetsc.follow(function, x0, -1.0, 1.0)

    p, _ = special(trunk, "branch-point")
    assert len(p) == 1
    assert abs(p[0]) < 1e-8
    assert len(halves) == 2
    at_end = {round(float(half["x"][-1].sum() - trunk["x"][-1].sum()), 8) for half in halves}
    assert at_end == {-1.0, 1.0}
    for half in halves:
        p = half["p"].values
        offset = half["x"].values.sum(axis=1) - (size == 2) * (p**2 - p)
        np.testing.assert_allclose(offset**2, p, atol=1e-9)
    if size == 1:
        assert trunk["unstable"].values[[0, -1]].tolist() == [0, 1]
        assert [int(half["unstable"][-1]) for half in halves] == [0, 0]


def test_cusp_has_two_folds():
    """Folds of p + 3 x - x^3 = 0 are at x = +-1, p = -+2; no branch point is there."""
    (curve,) = vipetsc.follow(lambda x, p: p + 3 * x - x**3, [-2.5], -5.0, 5.0)
    p, x = special(curve, "fold")
    order = np.argsort(p)
    np.testing.assert_allclose(p[order], [-2, 2], atol=1e-9)
    np.testing.assert_allclose(x[order, 0], [1, -1], atol=1e-6)
    assert curve.attrs["ending"] == "reached p = 5"


@pytest.mark.parametrize("with_jacobian", [True, False])
def test_bratu(with_jacobian):
    """The fold of u'' + p exp(u) = 0, u(0) = u(1) = 0, is at p = 3.513830719125 (two grids, extrapolated)."""
    folds = []
    for n in (19, 39):
        grid = (np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1) - 2 * np.eye(n)) * (n + 1) ** 2

        def bratu(u, p, grid=grid):
            return grid @ u + p * np.exp(u)

        def slope(u, p, grid=grid):
            return grid + np.diag(p * np.exp(u))

        jacobian = slope if with_jacobian else None
        (curve,) = vipetsc.follow(bratu, np.zeros(n), 1.0, 4.0, jacobian=jacobian, largest_step=0.5)
        p, _ = special(curve, "fold")
        assert len(p) == 1
        # It comes back to p = 1 on the upper part, where one perturbation grows.
        assert curve["p"].values[[0, -1]].tolist() == [1.0, 1.0]
        assert curve["unstable"].values[[0, -1]].tolist() == [0, 1]
        folds.append(p[0])
    extrapolated = (4 * folds[1] - folds[0]) / 3
    np.testing.assert_allclose(extrapolated, 3.513830719125, rtol=2e-6)


def test_closed_branch_is_followed_once():
    """A circle that crosses the trunk at two branch points is one curve, which closes."""
    trunk, *others = vipetsc.follow(lambda x, p: x * (x**2 + (p - 0.5) ** 2 - 0.04), [0.0], 0.0, 1.0)
    np.testing.assert_allclose(special(trunk, "branch-point")[0], [0.3, 0.7], atol=1e-8)
    (circle,) = others
    assert circle.attrs["ending"].startswith("closed")
    np.testing.assert_allclose(circle["x"].values[:, 0] ** 2 + (circle["p"].values - 0.5) ** 2, 0.04, atol=1e-7)


@pytest.mark.parametrize("x", [0.0, 0.4])
def test_no_solution_at_the_beginning(x):
    """x^2 + 1 has none; at x = 0 the derivative is singular too. Another curve can be followed thereafter."""
    with pytest.raises(ContinuationError, match="no solution at p = 0"):
        vipetsc.follow(lambda x, p: x**2 + 1, [x], 0.0, 1.0)
    (curve,) = vipetsc.follow(lambda x, p: x - p, [0.0], 0.0, 1.0)
    assert curve["x"].values[-1, 0] == pytest.approx(1.0)
