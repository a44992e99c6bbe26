"""Branches of condensed motions: exact solutions, breathers of the lattice, files, and cases that are refused."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ellipk

from tests.condensed_branches import condensed_branch, condensed_breather
from tests.models import CLEARANCE, four_band_contact
from vipetsc.case.nnm import NnmCase, NnmTable
from vipetsc.case.resolve import build_chain
from vipetsc.figures.registry import branch as draw
from vipetsc.io.state import State
from vipetsc.lattice import Chain, Contact, WaveCompliance, four_band
from vipetsc.lattice.sites import sites_at
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follow import claim_branches, follow_all
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import ContactPair, SmoothSpring, System
from vipetsc.parallel import StopRequest

HERTZ = four_band_contact("hertz")
BREATHER = """
[lattice]
preset = "four-band"
reading = "calibrated"
cells = {cells}
[contacts]
restitution = 1.0
sites = [{site}]
[nnm]
system = "{system}"
start_frequency = [{omega}]
points = {points}
first_step = 1e-2
tolerance = 1e-11
"""


def test_a_mass_between_two_stops_has_its_period_in_closed_form():
    """The period is four times the sum of two times, each of a harmonic motion.

    Up to the stop the mass moves with the stiffness k, beyond it with k + kc about another middle.
    """
    k = 3.0
    kc = 40.0
    m = 2.0
    clearance = 0.1
    slow = np.sqrt(k / m)
    fast = np.sqrt((k + kc) / m)
    pair = ContactPair(host=None, resonator=0, clearance=clearance, law=Contact("bilinear", kc))
    system = System.assemble([m], [(None, 0, k)], [pair])

    problem, points = condensed_branch(system, 0, 0.5 * k * (0.99 * clearance) ** 2, truncation=1e-7, points=6)
    for factor in (1.3, 3.0):
        points.append(problem.in_gap(factor * slow, np.array([1.0])))

    # The first point has no contact yet.
    assert points[0].frequency == pytest.approx(slow / (2 * np.pi), rel=1e-12)
    assert points[0].truncation < 1e-15
    for point in points:
        amplitude = float(point.elongations[0])
        energy = 0.5 * k * amplitude**2 + 0.5 * kc * max(amplitude - clearance, 0) ** 2
        quarter = np.pi / 2 / slow
        if amplitude > clearance:
            middle = kc * clearance / (k + kc)
            quarter = np.arcsin(clearance / np.sqrt(2 * energy / k)) / slow
            quarter += np.arccos((clearance - middle) / (amplitude - middle)) / fast
        assert point.frequency == pytest.approx(1 / (4 * quarter), rel=3e-7)
        assert point.energy == pytest.approx(energy, rel=1e-6)
    # The last point is far in contact, where the motion has many harmonics.
    assert points[-1].elongations[0] > 2 * clearance


def test_a_cubic_spring_has_the_period_of_elliptic_functions():
    """Duffing's oscillator x'' + x + x^3 = 0 with the amplitude a has the frequency (1 + a^2)^(1/2)/(4 K(m)).

    K is the complete elliptic integral of the first kind, with the parameter m = a^2/(2 (1 + a^2)).
    """
    system = System.assemble([1.0], [(None, 0, 1.0)], smooth=[SmoothSpring.between(None, 0, cubic=1.0)])
    _, points = condensed_branch(system, 0, 1e-3, truncation=1e-10, points=25, largest_step=0.3)
    for point in points:
        a = float(point.elongations[0])
        frequency = np.sqrt(1 + a**2) / (4 * ellipk(a**2 / (2 * (1 + a**2))))
        assert point.frequency == pytest.approx(frequency, rel=1e-9)
        assert point.energy == pytest.approx(a**2 / 2 + a**4 / 4, rel=1e-9)
    # At the last point the cubic force exceeds the linear one.
    assert points[-1].elongations[0] > 1


@pytest.mark.parametrize("omega", [1600.0, 3700.0, 5000.0])
def test_the_built_in_lattice_has_breathers_in_its_gaps(omega):
    """A breather of every gap, and above all bands, has the frequency asked for and a small residual."""
    _, point = condensed_breather(cells=300, site=100, omega=omega, truncation=1e-6)
    assert point.residual < 1e-11
    assert point.frequency == pytest.approx(omega / (2 * np.pi), rel=1e-14)


class CountedCompliance(WaveCompliance):
    """A compliance that counts the frequencies at which waves are solved."""

    frequencies = 0

    def at(self, omegas: np.ndarray) -> np.ndarray:
        self.frequencies += np.size(omegas)
        return super().at(omegas)


def test_the_cost_of_a_breather_does_not_grow_with_the_cells():
    """A lattice of a million cells needs at most twice the frequencies of one of 300 cells."""
    counts = {}
    for cells in (300, 1_000_000):
        cell = four_band("calibrated")
        chain = Chain(cell, cells, "fixed", sites_at([cells // 3], cell.pair, clearances=CLEARANCE))
        compliance = CountedCompliance(chain)
        control = NnmTable(truncation=1e-5, tolerance=1e-11)
        problem = ConservativeMotions(compliance, SiteForces([Stops.both(HERTZ, CLEARANCE)]), control)
        problem.in_gap(4000.0, np.array([1.0]))
        counts[cells] = compliance.frequencies
    assert counts[1_000_000] <= 2 * counts[300]


def chain_case(
    omega: str = "4000.0",
    points: int = 3,
    cells: int = 60,
    site: int = 20,
    system: str = "condensed",
    more: str = "truncation = 1e-5",
) -> NnmCase:
    """Return the case of a branch of a breather; ``more`` are lines of its section."""
    text = BREATHER.format(omega=omega, points=points, cells=cells, site=site, system=system)
    return NnmCase.from_toml(f"{text}{more}\n")


def followed(case: NnmCase, folder: Path, resume: bool = False, stop: StopRequest | None = None) -> list[Branch]:
    """Return the branches of a case, followed as the verb ``nnm`` does."""
    with claim_branches(case, folder, MPI.COMM_SELF, resume=resume) as claim:
        branches = follow_all(case, claim.folder, MPI.COMM_SELF, claim.going_on, None, stop)
        claim.publish()
    return branches


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Branch, Path]:
    """The branch of ``chain_case``, followed at once, and its file."""
    folder = tmp_path_factory.mktemp("whole")
    (branch,) = followed(chain_case(), folder)
    return branch, folder / "branch-breather-4000.h5"


def test_a_branch_is_stored_with_states_and_a_table_and_drawn(whole):
    """The stored state has the energy of its point, u^T K u/2 plus the contact's; the branch has a table and figure."""
    case = chain_case()
    branch, file = whole

    # The state at rest has the energy of the point: all of it is in springs and the contact.
    state = State.read(file, orbit=1)
    assert state.period == pytest.approx(2 * np.pi / 4000)
    chain = build_chain(case.lattice, case.contacts)
    u = state.on(0, 60)[0]
    w = u[19, chain.cell.resonator] - u[19, chain.cell.host]
    energy = 0.5 * u.ravel() @ chain.stiffness_matrix() @ u.ravel() + HERTZ.elastic_energy(np.abs(w) - CLEARANCE)
    # The state has the harmonics up to a truncation of 1e-5.
    assert branch.points[0].energy == pytest.approx(float(energy), rel=1e-5)

    lines = file.with_suffix(".csv").read_text().splitlines()
    assert lines[0].startswith("energy,frequency,period,w1,harmonics,truncation")
    assert len(lines) == 1 + len(branch.points)
    assert isinstance(draw([file]), Figure)


def test_a_frequency_at_which_no_breather_begins_is_refused_with_a_remedy():
    """The error for 2200 rad/s, in a gap but without a breather, names the key to change."""
    with pytest.raises(ContinuationError, match=r"no breather starts at 2200 rad/s: .*change nnm.start_frequency"):
        condensed_breather(cells=300, site=100, omega=2200.0)
