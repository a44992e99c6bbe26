"""The effective restitution of an impact with the paper's and with the exact damping."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vipetsc
from tests.unit.test_contact import CLEARANCE, LAWS, MASS, STIFFNESS, closed_sites
from vipetsc.contact.law import contact_force
from vipetsc.lattice import Contact


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
@pytest.mark.parametrize(
    ("asked", "effective"), [(0.0, 0.4877413), (0.3, 0.5812880), (0.5, 0.6629622), (0.7, 0.7679998), (0.9, 0.9090157)]
)
def test_the_papers_damping_returns_more_than_is_asked(law, asked, effective):
    """An integrated impact with g = 1 + c w'/w'_minus, c = 3 (1 - e)/2, has the effective restitution, above e."""
    contact = Contact(law, STIFFNESS, asked)
    assert integrated_restitution(contact) == pytest.approx(contact.effective_restitution, rel=1e-6)
    assert contact.effective_restitution == pytest.approx(effective, rel=1e-6)


@LAWS
@pytest.mark.parametrize("asked", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_the_exact_damping_returns_what_is_asked(law, asked):
    """An integrated impact with the exact damping has the restitution asked for."""
    contact = Contact(law, STIFFNESS, asked, factor="exact")
    assert integrated_restitution(contact) == pytest.approx(contact.effective_restitution, rel=1e-6)
    assert contact.effective_restitution == pytest.approx(asked, rel=1e-6)


def test_the_exact_damping_meets_every_restitution():
    """The exact damping has the effective restitution asked for, from 0.05 to 1."""
    asked = np.linspace(0.05, 1, 200)
    found = [Contact("hertz", STIFFNESS, restitution, factor="exact").effective_restitution for restitution in asked]
    assert found == pytest.approx(asked, abs=1e-7)


@pytest.mark.parametrize(("factor", "asked"), [("flores", 0.05), ("flores", 0.052), ("flores", 0.06)])
def test_the_strongest_damping_parts_the_masses_where_its_force_vanishes(factor, asked):
    """The effective restitution with Flores's damping approaches 1/c, where g = 0, if a small one is asked for."""
    contact = Contact("hertz", STIFFNESS, asked, factor=factor)
    c = 1.6 * (1 - asked) / asked
    # With 1 - c e = exp(-q) the equation for the effective restitution e has the root q = c + 1 - log(1 + c), up to
    # terms of the order exp(-q).
    expected = (1 - np.exp(np.log1p(c) - c - 1)) / c
    assert contact.effective_restitution == pytest.approx(expected, rel=1e-10)


def test_the_manual_has_a_table_of_effective_restitutions():
    """The manual's table has the effective restitutions of the paper's damping, rounded to three digits."""
    lines = (Path(vipetsc.__file__).parent / "manual/case-file.md").read_text(encoding="utf-8").splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("| restitution"))

    def numbers(line: str) -> list[float]:
        return [float(cell) for cell in line.split("|")[2:-1]]

    # The line between the two rows of numbers is the table's rule.
    asked = numbers(lines[first])
    printed = numbers(lines[first + 2])
    found = [round(Contact("hertz", STIFFNESS, restitution).effective_restitution, 3) for restitution in asked]
    assert found == printed
