"""An elastic law that a user's module registers acts alike in every part of the package that computes contact forces.

The module is the one in the manual's chapter *extend*: hardening stops with F = k x (1 + b x^2). Results are compared
with formulas that are written out in ``another_law``.
"""

from __future__ import annotations

import pytest

from tests.manual_modules import write_modules
from tests.verify.another_law import compare


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> dict:
    """The differences from the formulas, with the module in the current folder."""
    folder = tmp_path_factory.mktemp("another-law")
    write_modules(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return compare()


def test_the_law_on_arrays_and_its_compiled_twin_are_the_formula(found):
    """The law on arrays and the compiled one have the force k x (1 + b x^2), its slope, energy and impacts."""
    assert found["twins"] == pytest.approx(0, abs=1e-12)
    assert found["duration"] == pytest.approx(0, abs=1e-7)


def test_both_engines_follow_the_same_trajectory(found):
    """Both engines follow one trajectory with hardening stops, to 1e-6 of the largest velocity, with closed ledgers."""
    assert found["episodes"][0] == found["episodes"][1] > 4
    assert found["engines"] < 1e-6
    assert max(found["ledgers"]) < 1e-7
    # The hardening matters: a run with linear stops of the same stiffness differs.
    assert found["hardens"] > 1e-3


# The condensed method may leave out harmonics of 1e-4 of the motion: its error is larger than that of shooting.
@pytest.mark.parametrize(("method", "error"), [("shooting", 1e-8), ("balance", 1e-5)])
def test_normal_modes_have_the_period_of_the_energy_integral(found, method, error):
    """A mass between hardening stops has the period 4 int dx/sqrt(2 (E - V(x))/m), by shooting and condensed."""
    assert found["reached"][method] > 0.5
    assert found["periods"][method] < error
