"""Branches of condensed motions: exact solutions, shooting, files, cases; breathers of the lattice."""

from __future__ import annotations

import itertools

from mpi4py import MPI

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.special import ellipk

from vipetsc.case import CaseError
from vipetsc.case.nnm import NnmCase, NnmTable
from vipetsc.case.resolve import build_chain
from vipetsc.figures.registry import branch as draw
from vipetsc.io.state import State
from vipetsc.lattice import Chain, Contact, WaveCompliance, contact_stiffness, four_band, pass_bands
from vipetsc.lattice.moments import SeriesCompliance
from vipetsc.modes.balance.conservative import ConservativeMotions
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.condensed import condensed_system, state_of
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import claim_branches, follow_all
from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting.dop853 import Dop853Flow
from vipetsc.modes.shooting.maps import MAPS
from vipetsc.modes.shooting.orbit import resonance
from vipetsc.modes.shooting.shooting import Shooting
from vipetsc.modes.system import ContactPair, SmoothSpring, System
from vipetsc.parallel import StopRequest

D = 10**-2.75
HERTZ = Contact("hertz", contact_stiffness(1e8, 0.005, 0.3))
BREATHER = """
[lattice]
preset = "four-band"
reading = "calibrated"
cells = {cells}
[contacts]
restitution = 1.0
sites = [{site}]
[nnm]
system = "condensed"
start_frequency = [{omega}]
points = {points}
first_step = 1e-2
tolerance = 1e-11
"""


def condensed(system: System, **options) -> ConservativeMotions:
    return condensed_system(system, NnmTable(**{"tolerance": 1e-12, "first_step": 1e-2} | options))


def branch(system: System, mode: int, energy: float, **options) -> tuple[ConservativeMotions, list]:
    """Points of a branch that begins at a linear mode with an ``energy``."""
    problem, (omega, shapes) = condensed(system, **options), system.linear_modes()
    rows = np.vstack([system.contact_rows, system.spring_rows])
    z = rows @ shapes[:, mode] * np.sqrt(2 * energy) / omega[mode]
    start = problem.from_mode(z, float(omega[mode]))
    return problem, [start, *Continuation(problem, start, problem.control)]


def displacement(problem: ConservativeMotions, point: Point) -> np.ndarray:
    (u,) = state_of(problem, point).values()
    return u


@pytest.mark.slow
def test_a_mass_between_two_stops_has_its_period_in_closed_form():
    k, kc, m, clearance = 3.0, 40.0, 2.0, 0.1
    pair = ContactPair(None, 0, clearance, Contact("bilinear", kc))
    system = System.assemble([m], [(None, 0, k)], [pair])
    problem, points = branch(system, 0, 0.5 * k * (0.99 * clearance) ** 2, truncation=1e-7, points=6)
    points += [problem.from_gap(share * np.sqrt(k / m), np.array([1.0])) for share in (1.3, 3.0)]
    assert points[0].frequency == pytest.approx(np.sqrt(k / m) / (2 * np.pi), rel=1e-12)  # no contact yet
    assert points[0].truncation < 1e-15
    for point in points:
        amplitude = float(point.elongations[0])
        energy = 0.5 * k * amplitude**2 + 0.5 * kc * max(amplitude - clearance, 0) ** 2
        if amplitude <= clearance:
            quarter = np.pi / 2 * np.sqrt(m / k)
        else:
            middle, slow, fast = kc * clearance / (k + kc), np.sqrt(k / m), np.sqrt((k + kc) / m)
            quarter = np.arcsin(clearance / np.sqrt(2 * energy / k)) / slow
            quarter += np.arccos((clearance - middle) / (amplitude - middle)) / fast
        assert point.frequency == pytest.approx(1 / (4 * quarter), rel=3e-7)
        assert point.energy == pytest.approx(energy, rel=1e-6)
    assert points[-1].elongations[0] > 2 * clearance


def test_a_cubic_spring_has_the_period_of_elliptic_functions():
    system = System.assemble([1.0], [(None, 0, 1.0)], smooth=[SmoothSpring.between(None, 0, cubic=1.0)])
    _, points = branch(system, 0, 1e-3, truncation=1e-10, points=25, largest_step=0.3)
    for point in points:
        a = float(point.elongations[0])
        frequency = np.sqrt(1 + a**2) / (4 * ellipk(a**2 / (2 * (1 + a**2))))
        assert point.frequency == pytest.approx(frequency, rel=1e-9)
        assert point.energy == pytest.approx(a**2 / 2 + a**4 / 4, rel=1e-9)
    assert points[-1].elongations[0] > 1


def test_the_slope_of_the_energy_is_that_between_points():
    _, points = branch(reduced("hertz"), 1, 0.028, points=20, truncation=1e-6)
    for a, b in itertools.pairwise([p for p in points if p.episodes][3:]):
        chord = (b.frequency - a.frequency) / (b.energy - a.energy)
        assert min(a.slope, b.slope) * 0.99 <= chord <= max(a.slope, b.slope) * 1.01


def reduced(law: str, power: float | None = None) -> System:
    return System.reduced(four_band(), D, Contact(law, HERTZ.stiffness, exponent=power))


KERSCHEN = System.assemble(
    [1.0, 1.0], [(None, 0, 1.0), (0, 1, 1.0), (None, 1, 1.0)], smooth=[SmoothSpring.between(None, 0, cubic=0.5)]
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "mode", "energy", "truncation"),
    [
        (KERSCHEN, 0, 1e-2, 1e-9),
        (KERSCHEN, 1, 1e-2, 1e-9),
        (reduced("hertz"), 0, 0.0034, 1e-8),
        (reduced("power", 2.3), 1, 0.028, 1e-8),
        (reduced("bilinear"), 3200.0, 0.0, 1e-7),  # rad/s: from a describing function
    ],
)
def test_same_curves_as_by_shooting(system, mode, energy, truncation):
    """The corrected orbit of shooting has the frequency of the branch at its energy, to 1e-6."""
    if energy:
        problem, points = branch(system, mode, energy, truncation=truncation, points=12)
    else:
        problem = condensed(system, truncation=truncation, points=2)
        points = list(Continuation(problem, problem.from_gap(mode, np.array([1.0])), problem.control))
    assert system.springs or points[-1].episodes
    shooting = Shooting(Dop853Flow(system), MAPS["quarter"], 1e-12)
    for point in points[:0:-4]:
        u = displacement(problem, point)
        frame = shooting.relative_frame(u, point.period)
        row = np.append(u / np.linalg.norm(u), 0.0)
        attempt = frame.solve(frame.xi, row, row @ frame.xi)
        assert attempt.converged
        orbit = frame.measures(attempt)
        nonlinear = bool(point.episodes or system.springs)
        here = point.frequency + (point.slope * (orbit.energy - point.energy) if nonlinear else 0.0)
        assert orbit.frequency == pytest.approx(here, rel=1e-6)
        assert point.energy == pytest.approx(system.energy(u, 0 * u), rel=1e-6)


def breather(cells: int, site: int, omega: float, truncation=1e-8, **options) -> tuple[ConservativeMotions, Point]:
    chain = Chain(four_band("calibrated"), cells, "fixed", (site - 1,), (D,))
    control = NnmTable(truncation=truncation, tolerance=1e-12, **options)
    problem = ConservativeMotions(SeriesCompliance(WaveCompliance(chain)), SiteForces([(HERTZ, D)]), control)
    return problem, problem.from_gap(omega, np.array([1.0]))


@pytest.mark.parametrize("omega", [1450.0, 1600.0, 1800.0, 2000.0, 3700.0, 4000.0, 5000.0])
def test_breathers_of_the_built_in_lattice(omega):
    _, point = breather(300, 100, omega, 1e-6)
    if omega == 1600.0:
        assert point.elongations[0] / D == pytest.approx(1.286, abs=5e-4)
        assert point.energy == pytest.approx(0.0203, abs=5e-5)
    assert point.residual < 1e-11
    assert point.frequency == pytest.approx(omega / (2 * np.pi), rel=1e-14)


@pytest.mark.slow
def test_a_breather_returns_after_a_period_in_its_chain():
    chain = Chain(four_band("calibrated"), 12, "fixed", (5,), (D,))
    problem, point = breather(12, 6, 1600.0, 2e-9, max_newton=12)
    state = state_of(problem, point)
    u = np.concatenate([state[cell] for cell in range(12)])
    system = System.from_chain(chain, HERTZ)
    assert point.energy == pytest.approx(system.energy(u, 0 * u), rel=1e-8)
    flow = Dop853Flow(system)
    end = flow.arc(np.append(u, 0 * u), point.period, point.period).end
    assert np.abs(end[:48] - u).max() < 1e-8 * np.abs(u).max()
    assert np.abs(end[48:]).max() < 1e-8 * np.abs(u).max() * 2 * np.pi / point.period


def test_the_cost_does_not_grow_with_the_cells():
    def frequencies(cells: int) -> int:
        """How many frequencies waves are solved at for a breather."""
        chain = Chain(four_band("calibrated"), cells, "fixed", (cells // 3,), (D,))
        compliance, asked = WaveCompliance(chain), 0

        class Counted(SeriesCompliance):
            def at(self, omegas):
                nonlocal asked
                asked += np.size(omegas)
                return super().at(omegas)

        control = NnmTable(truncation=1e-5, tolerance=1e-11)
        problem = ConservativeMotions(Counted(compliance), SiteForces([(HERTZ, D)]), control)
        problem.from_gap(4000.0, np.array([1.0]))
        return asked

    assert frequencies(1_000_000) <= 2 * frequencies(300)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("sites", [(3, 20, 150, 299), (0,), (150, 152)])
def test_moments_are_the_compliance_far_above_the_bands(ends, sites):
    chain = Chain(four_band("calibrated"), 300, ends, sites, (D,) * len(sites))
    omega = pass_bands(chain.cell)[-1].high * np.array([0.5, 2.01, 3.0, 20.0 - 1e-3j])
    exact = WaveCompliance(chain).at(omega)
    assert SeriesCompliance(WaveCompliance(chain)).at(omega) == pytest.approx(
        exact, rel=0, abs=1e-14 * np.abs(exact).max()
    )


def two_sites(signs: list[int]) -> Point:
    chain = Chain(four_band("calibrated"), 60, "fixed", (28, 31), (D, D))
    control = NnmTable(truncation=1e-6, tolerance=1e-11)
    problem = ConservativeMotions(SeriesCompliance(WaveCompliance(chain)), SiteForces([(HERTZ, D)] * 2), control)
    return problem.from_gap(4000.0, np.array(signs))


def test_two_sites_in_and_out_of_phase():
    alone, together, against = two_sites([1, 0]), two_sites([1, 1]), two_sites([1, -1])
    assert together.elongations[0] == pytest.approx(together.elongations[1], rel=1e-9)  # mirror images
    assert against.elongations[0] == pytest.approx(-against.elongations[1], rel=1e-9)
    assert abs(alone.elongations[1]) < D
    assert together.energy + against.energy == pytest.approx(4 * alone.energy, rel=0.05)


def case(omega: str = "4000.0", points: int = 3, cells: int = 60, site: int = 20, more: str = "") -> NnmCase:
    more = more if "truncation" in more else f"truncation = 1e-5\n{more}"
    return NnmCase.from_toml(BREATHER.format(omega=omega, points=points, cells=cells, site=site) + more)


def followed(given: NnmCase, folder, resume: bool = False, stop: StopRequest | None = None):
    with claim_branches(given, folder, MPI.COMM_SELF, resume=resume) as claim:
        branches = follow_all(given, claim.folder, MPI.COMM_SELF, claim.going_on, None, stop)
        claim.publish()
    return branches


@pytest.mark.slow
def test_files_states_and_the_way_on(tmp_path):
    (whole,) = followed(case(), tmp_path / "whole")
    (part,) = followed(case(points=2), tmp_path / "part")
    assert "resume" in part.ending
    (rest,) = followed(case(), tmp_path / "part", resume=True)
    read = read_branch(tmp_path / "whole" / "branch-breather-4000.h5")
    for point, other, stored in zip(whole.points, rest.points, read.points, strict=True):
        assert np.array_equal(point.x, other.x)
        assert np.array_equal(point.x, stored.x)
        assert np.array_equal(point.tangent, stored.tangent)
        assert (point.energy, point.truncation, point.order) == (stored.energy, stored.truncation, stored.order)
    state = State.read(tmp_path / "whole" / "branch-breather-4000.h5", orbit=1)
    assert state.period == pytest.approx(2 * np.pi / 4000)
    u = state.on(0, 60)[0].ravel()
    chain = build_chain(case().lattice, case().contacts)
    energy = 0.5 * u @ chain.stiffness_matrix() @ u + HERTZ.potential(u[4 * 19 + 2] - u[4 * 19 + 1], D)
    assert whole.points[0].energy == pytest.approx(float(energy), rel=1e-5)
    lines = (tmp_path / "whole" / "branch-breather-4000.csv").read_text().splitlines()
    assert lines[0].startswith("energy,frequency,period,w1,harmonics,truncation")
    assert len(lines) == 1 + len(whole.points)
    assert isinstance(draw([tmp_path / "whole" / "branch-breather-4000.h5"]), Figure)


@pytest.mark.slow
def test_a_stopped_branch_goes_on(tmp_path):
    stop = StopRequest()
    stop.requested = True
    (begun,) = followed(case(), tmp_path / "b", stop=stop)
    assert begun.ending.startswith("stopped on request after point 1")
    (rest,) = followed(case(), tmp_path / "b", resume=True)
    (whole,) = followed(case(), tmp_path / "w")
    assert [p.energy for p in rest.points] == [p.energy for p in whole.points]


@pytest.mark.slow
def test_a_branch_that_fails_keeps_its_points_and_names_the_knob(tmp_path):
    more = "harmonics = 61\ntruncation = 1e-5\ndirection = 'up'\nsmallest_step = 1e-4"
    (stuck,) = followed(case("3700.0", 60, more=more.replace("1e-5", "4.4e-7")), tmp_path)
    assert stuck.ending.startswith("failed: step below")
    assert "nnm.harmonics or nnm.truncation" in stuck.ending
    assert "E = " in stuck.ending
    assert len(read_branch(tmp_path / "branch-breather-3700.h5").points) == len(stuck.points) > 0


def test_where_no_breather_begins():
    with pytest.raises(ContinuationError, match=r"no breather begins at 2200 rad/s: .*change nnm.start_frequency"):
        breather(300, 100, 2200.0)


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ("1000.0", "nnm.start_frequency"),  # in a pass band
        ("", "nnm.start_frequency"),
        ("4000.0]\nstart_sites = [2", "nnm.start_sites"),
        ("4000.0]\ncompare = ['tsrk'", "nnm.compare"),
        ("4000.0]\nharmonics = [3", "nnm.harmonics"),
    ],
)
def test_bad_cases_are_refused(change, key):
    with pytest.raises(CaseError, match=key):
        case(change)


def test_branches_shot_with_dense_matrices_have_no_start_frequency():
    for system in ("reduced", 'chain"\nshooting = "dense'):
        text = BREATHER.format(omega=4000.0, points=3, cells=3, site=2).replace("condensed", system)
        with pytest.raises(CaseError, match=r"nnm.start_frequency"):
            NnmCase.from_toml(text)


@pytest.mark.slow
def test_the_tongues_of_the_in_phase_mode_are_followed():
    """Kerschen's 3:1 and 5:1: a harmonic balance passes their tips, and shooting from it finds the same orbits."""
    problem, points = branch(KERSCHEN, 0, 1.0, truncation=1e-7, points=130, largest_step=0.15)
    energy = np.array([p.energy for p in points])
    tips = 1 + np.nonzero((energy[1:-1] > energy[:-2]) & (energy[1:-1] > energy[2:]))[0]
    assert energy[tips] == pytest.approx([4679, 2100, 107310], rel=1e-2)
    shooting, counts = Shooting(Dop853Flow(KERSCHEN), MAPS["quarter"], 1e-12), []
    for i in (*tips, *(tips + 4)):
        point, u, before = points[i], displacement(problem, points[i]), displacement(problem, points[i - 1])
        frame = shooting.relative_frame(u, point.period)
        row = frame.xi - frame.chart.encode(before, points[i - 1].period)  # at the same length along the branch
        attempt = frame.solve(frame.xi, row / np.linalg.norm(row), row @ frame.xi / np.linalg.norm(row))
        orbit = frame.measures(attempt)
        assert attempt.converged
        assert orbit.frequency == pytest.approx(point.frequency, rel=1e-8)
        assert orbit.energy == pytest.approx(point.energy, rel=1e-6)
        counts.append(resonance(shooting, orbit))
    assert counts[:3] == [3, 3, 5]
    assert max(p.order for p in points) < 100
