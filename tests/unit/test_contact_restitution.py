"""The effective restitution of an impact by every law and every factor of dissipation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.unit.test_contact import CLEARANCE, LAWS, MASS, STIFFNESS, closed_sites, contact_of
from vipetsc.contact.law import contact_force
from vipetsc.lattice import Contact
from vipetsc.lattice.contact import DAMPINGS


def integrated_restitution(contact: Contact) -> float:
    """Return the speed after an impact over the speed before it, from the motion under the compiled force."""
    speed = 0.3
    contacts = closed_sites(contact, 1, speed)

    def rates(t: float, z: np.ndarray) -> list[float]:
        return [z[1], -contact_force(contacts, 0, CLEARANCE + z[0], z[1])[0] / MASS]

    def separates(t: float, z: np.ndarray) -> float:
        # The indentation is zero at the start, too.
        return z[0] if t > 1e-6 else 1.0

    separates.terminal = True
    separates.direction = -1
    impact = solve_ivp(rates, (0, 1), [0.0, speed], rtol=1e-11, atol=1e-14, events=separates, first_step=2e-6)
    return -impact.y[1, -1] / speed


@LAWS
@pytest.mark.parametrize("factor", DAMPINGS)
@pytest.mark.parametrize("asked", [0.3, 0.9])
def test_an_integrated_impact_has_the_effective_restitution(law, factor, asked):
    """The speed after an impact is as said, for every law and every factor of dissipation."""
    contact = contact_of(law, asked, factor=factor)
    assert integrated_restitution(contact) == pytest.approx(contact.effective_restitution, rel=1e-6)


@pytest.mark.parametrize(
    ("factor", "asked", "effective"),
    [
        ("paper", 0.0, 0.4877413),  # g = 1 + c w'/w'_minus with c = 3 (1 - e)/2
        ("paper", 0.5, 0.6629622),
        ("hunt-crossley", 0.5, 0.6629622),
        ("lankarani-nikravesh", 0.5, 0.72524),  # c = 3 (1 - e^2)/4
        ("flores", 0.5, 0.47044),  # c = 8 (1 - e)/(5 e)
        ("exact", 0.05, 0.05),
        ("exact", 0.7, 0.7),
    ],
)
def test_factors_of_dissipation_return_what_is_published(factor, asked, effective):
    """Factors that are derived for weak losses return another part of the speed than is asked for."""
    assert contact_of("hertz", asked, factor=factor).effective_restitution == pytest.approx(effective, abs=5e-6)


@pytest.mark.parametrize(("factor", "asked"), [("flores", 0.05), ("flores", 0.052), ("flores", 0.06)])
def test_the_strongest_damping_parts_the_masses_where_its_force_vanishes(factor, asked):
    """The effective restitution with Flores's damping approaches 1/c, where g = 0, if a small one is asked for."""
    contact = Contact("hertz", STIFFNESS, asked, factor=factor)
    c = 1.6 * (1 - asked) / asked
    # With 1 - c e = exp(-q) the equation for the effective restitution e has the root q = c + 1 - log(1 + c), up to
    # terms of the order exp(-q).
    expected = (1 - np.exp(np.log1p(c) - c - 1)) / c
    assert contact.effective_restitution == pytest.approx(expected, rel=1e-10)
