"""What holds for every branch of normal modes, tried on a zoo of systems, each followed once by both methods.

SciPy integrates equations that are written here from the tables of the cases.
"""

from __future__ import annotations

import csv
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import mkdtemp
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.models import KERSCHEN
from vipetsc.case import NnmCase
from vipetsc.modes.branches.balance import BalanceMethod, state_of
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all

PAIR = {
    "masses": [1.0, 1.5],
    "springs": [{"start": start, "end": end, "stiffness": 1.0} for start, end in ((0, 1), (1, 2), (0, 2))],
}
THREE = {
    "masses": [1.0, 0.8, 1.3],
    "springs": [{"start": start, "end": end, "stiffness": 1.0} for start, end in ((0, 1), (1, 2), (2, 3), (0, 3))],
}
BILINEAR = {"law": "bilinear", "stiffness": 5.0}
HERTZ = {"law": "hertz", "stiffness": 5.0}
EXPONENTS = {"bilinear": 1.0, "hertz": 1.5}
BETWEEN = [{"host": 1, "resonator": 2, "clearance": 0.1}]
TO_GROUND = [{"host": 0, "resonator": 1, "clearance": 0.1}, {"host": 0, "resonator": 3, "clearance": 0.13}]
GRAINS = [{"host": start, "resonator": end, "clearance": 0.0} for start, end in ((0, 1), (1, 2), (2, 3), (0, 3))]


class Kind(NamedTuple):
    """A system of masses with contacts, the mode whose branch is followed, and the energy at which it begins."""

    own: dict[str, Any]
    contacts: dict[str, Any]
    mode: int
    energy: float

    def case(self, method: str, **nnm: Any) -> NnmCase:
        """Return the case of a branch; ``nnm`` updates its section."""
        options = {"system": "own", "own": self.own, "modes": [self.mode], "method": method, "points": 14}
        options |= {"start_energy": self.energy, "energy": [0.0, 60 * self.energy], "tolerance": 1e-11}
        options |= {
            "largest_step": 0.3,
            "first_step": 0.1,
            "truncation": 1e-5,
            "harmonics": 127,
            "locate_grazing": True,
        }
        table = {"name": "zoo", "nnm": options | nnm}
        if self.contacts:
            table["contacts"] = self.contacts
        return NnmCase.from_table(table)


ZOO = {
    "hardening": Kind(KERSCHEN, {}, 2, 0.5),
    "uneven spring": Kind(PAIR | {"smooth": [{"start": 0, "end": 1, "quadratic": 0.4, "cubic": 0.5}]}, {}, 1, 0.05),
    "stops on both sides": Kind(PAIR | {"contacts": BETWEEN}, BILINEAR, 2, 0.002),
    "Hertz": Kind(PAIR | {"contacts": BETWEEN}, HERTZ, 2, 0.002),
    "one side": Kind(PAIR | {"contacts": BETWEEN}, BILINEAR | {"side": "plus"}, 2, 0.002),
    "two stops": Kind(THREE | {"contacts": TO_GROUND}, BILINEAR | {"each": {"side": ["plus", "minus"]}}, 2, 0.005),
    "a stop beside a curved spring": Kind(
        PAIR | {"contacts": BETWEEN, "smooth": [{"start": 0, "end": 1, "cubic": 3.0}]}, BILINEAR, 2, 0.01
    ),
    "pressed grains": Kind(
        THREE | {"springs": [{"start": 1, "end": 2, "stiffness": 0.2}], "contacts": GRAINS},
        HERTZ | {"precompression": 0.1, "each": {"side": ["minus", "minus", "minus", "plus"]}},
        2,
        2e-3,
    ),
}
EVERY = [(name, method) for name in ZOO for method in ("shooting", "balance")]
every_branch = pytest.mark.parametrize(("name", "method"), EVERY)
# Harmonics are left out where they are smaller than ``truncation``; kinks have many.
ERRORS = {"shooting": 1e-7, "balance": 2e-4}


@cache
def followed(name: str, method: str) -> tuple[Branch[Any], Path]:
    """Return the branch of a kind by one method, and its folder."""
    folder = Path(mkdtemp(prefix="branch-"))
    (branch,) = follow_all(ZOO[name].case(method), folder, MPI.COMM_SELF)
    assert len(branch.regular()) > 4, branch.ended.sentence
    return branch, folder


class Equations:
    """The motion of a kind's masses, as its table says: forces and the energy, whose static loads are in balance."""

    def __init__(self, kind: Kind) -> None:
        self.masses = np.array(kind.own["masses"])
        n = len(self.masses)

        def row(part: dict[str, Any], begin: str, end: str) -> np.ndarray:
            both = np.zeros(n + 1)
            both[part[end]] += 1
            both[part[begin]] -= 1
            # The first entry is the ground.
            return both[1:]

        self.stiffness = np.zeros((n, n))
        for spring in kind.own["springs"]:
            along = row(spring, "start", "end")
            self.stiffness += spring["stiffness"] * np.outer(along, along)
        self.curved = [
            (row(spring, "start", "end"), spring.get("quadratic", 0.0), spring.get("cubic", 0.0))
            for spring in kind.own.get("smooth", [])
        ]
        self.stops = []
        common = kind.contacts
        for number, contact in enumerate(kind.own.get("contacts", [])):
            side = common.get("each", {}).get("side", [common.get("side", "both")] * (number + 1))[number]
            gap = contact["clearance"] - common.get("precompression", 0.0)
            for name, sign in (("plus", 1), ("minus", -1)):
                if side in (name, "both"):
                    self.stops.append((sign * row(contact, "host", "resonator"), gap))
        if common:
            self.contact = common["stiffness"]
            self.exponent = EXPONENTS[common["law"]]

    def acceleration(self, u: np.ndarray) -> np.ndarray:
        """Return accelerations (mass,) in m/s^2 at displacements ``u`` (mass,) in m."""
        force = -self.stiffness @ u
        for row, quadratic, cubic in self.curved:
            z = row @ u
            force = force - (quadratic * z**2 + cubic * z**3) * row
        for row, gap in self.stops:
            push = max(row @ u - gap, 0.0) ** self.exponent - max(-gap, 0.0) ** self.exponent
            force = force - self.contact * push * row
        return force / self.masses

    def energy(self, u: np.ndarray, v: np.ndarray) -> float:
        """Return the energy in J above that of the state at rest."""
        total = self.masses @ v**2 / 2 + u @ self.stiffness @ u / 2
        for row, quadratic, cubic in self.curved:
            z = row @ u
            total += quadratic * z**3 / 3 + cubic * z**4 / 4
        for row, gap in self.stops:
            pressed = max(-gap, 0.0)
            power = self.exponent + 1
            stored = (max(row @ u - gap, 0.0) ** power - pressed**power) / power - pressed**self.exponent * (row @ u)
            total += self.contact * stored
        return float(total)

    def after(self, states: np.ndarray, period: float) -> np.ndarray:
        """Return the states (state, 2 mass) a ``period`` after ``states``, which are integrated together."""
        n = len(self.masses)

        def rate(_: float, y: np.ndarray) -> np.ndarray:
            rows = y.reshape(states.shape)
            return np.concatenate([np.append(row[n:], self.acceleration(row[:n])) for row in rows])

        options = {"rtol": 1e-11, "atol": 1e-14 * np.abs(states).max(), "max_step": period / 100}
        return solve_ivp(rate, (0, period), states.ravel(), "DOP853", **options).y[:, -1].reshape(states.shape)


def rest_of(name: str, method: str, point: Any) -> np.ndarray:
    """Return displacements (mass,) in m of a motion where it rests."""
    if method == "shooting":
        return np.array(point.x)
    motions = BalanceMethod(ZOO[name].case(method)).motions
    return np.concatenate(list(state_of(motions, point, len(ZOO[name].own["masses"])).values()))


@every_branch
def test_motions_repeat_themselves_with_their_energy_and_multiplier(name, method):
    """A motion in the middle of the branch and its last one: return, energy, largest multiplier."""
    branch, _ = followed(name, method)
    equations = Equations(ZOO[name])
    regular = branch.regular()
    for point in (regular[len(regular) // 2], regular[-1]):
        u = rest_of(name, method, point)
        n = len(u)
        start = np.append(u, np.zeros(n))
        scale = np.abs(u).max() * np.append(np.ones(n), np.full(n, 2 * np.pi / point.period))
        assert equations.energy(u, np.zeros(n)) == pytest.approx(point.energy, rel=10 * ERRORS[method])

        step = 1e-6 * np.diag(scale)
        ends = equations.after(np.vstack([start, start + step, start - step]), point.period)
        assert np.abs((ends[0] - start) / scale).max() < ERRORS[method]
        assert equations.energy(ends[0, :n], ends[0, n:]) == pytest.approx(equations.energy(u, 0 * u), rel=1e-8)
        monodromy = ((ends[1 : 1 + 2 * n] - ends[1 + 2 * n :]) / (2 * np.diag(step)[:, None])).T
        largest = np.abs(np.linalg.eigvals(monodromy)).max()
        # Two multipliers of an orbit are 1, and differences split them by the root of their error.
        if np.isfinite(point.multiplier):
            assert point.multiplier == pytest.approx(largest, rel=0.02)
    if ZOO[name].contacts:
        assert regular[-1].episodes > 0


@every_branch
def test_points_are_in_order(name, method):
    """Slopes are those between the points; folds are where the energy turns; contacts begin where one is touched."""
    branch, _ = followed(name, method)
    equations = Equations(ZOO[name])
    for left, right in pairwise(branch.regular()[1:]):
        if left.episodes == right.episodes and np.isfinite([left.slope, right.slope]).all():
            chord = (right.frequency - left.frequency) / (right.energy - left.energy)
            low, high = sorted((left.slope, right.slope))
            margin = 0.1 * max(abs(low), abs(high)) + 1e-9
            assert low - margin <= chord <= high + margin
    for point in branch.points:
        if point.kind == "fold-energy":
            assert abs(point.energy_tangent) < 1e-6 * point.energy
        # A pressed contact opens at the other rest of the motion.
        starts_at_touch = point.episodes == 0 and "precompression" not in ZOO[name].contacts
        if point.kind == "grazing" and method == "shooting" and starts_at_touch:
            u = rest_of(name, method, point)
            nearest = min(abs(sign * (row @ u) - gap) for row, gap in equations.stops for sign in (1, -1))
            assert nearest < 1e-8


@every_branch
def test_files_give_the_branch_back(name, method):
    """The file has every number of every point, and its table has a row for each."""
    branch, folder = followed(name, method)
    (path,) = folder.glob("branch-*.h5")
    again = read_branch(path)
    assert again.ended == branch.ended
    assert again.findings == branch.findings
    assert again.next_step == branch.next_step
    for read, point in zip(again.points, branch.points, strict=True):
        for field in ("x", "tangent", "half_traces", "elongations"):
            np.testing.assert_array_equal(getattr(read, field), getattr(point, field))
        for field in ("energy", "period", "multiplier", "slope", "residual", "closed", "truncation"):
            np.testing.assert_equal(getattr(read, field), getattr(point, field))
        assert (read.kind, read.episodes, read.index, read.order) == (
            point.kind,
            point.episodes,
            point.index,
            point.order,
        )
    with path.with_suffix(".csv").open() as table:
        rows = list(csv.DictReader(table))
    assert [float(row["energy"]) for row in rows] == [point.energy for point in branch.points]
    assert [row["kind"] for row in rows] == [point.kind for point in branch.points]


OTHER = {"plus": "minus", "minus": "plus", "both": "both"}


@pytest.mark.parametrize("name", [name for name, kind in ZOO.items() if "side" in str(kind.contacts)])
def test_stops_on_the_other_sides_have_the_same_branch(name):
    """A system seen from the other side has the mirrored motions, with the same energies and periods."""
    method = "balance"
    kind = ZOO[name]
    contacts = dict(kind.contacts)
    if "side" in contacts:
        contacts["side"] = OTHER[contacts["side"]]
    if "each" in contacts:
        contacts["each"] = {"side": [OTHER[side] for side in contacts["each"]["side"]]}
    (image,) = follow_all(kind._replace(contacts=contacts).case(method), None, MPI.COMM_SELF)
    branch, _ = followed(name, method)
    for field in ("energy", "period", "multiplier"):
        found = [getattr(point, field) for point in image.regular()]
        np.testing.assert_allclose(found, [getattr(point, field) for point in branch.regular()], rtol=1e-6)


@pytest.mark.parametrize("name", ZOO)
def test_both_methods_follow_one_branch(name):
    """Frequencies by harmonics lie on the branch of orbits, between whose points they are interpolated."""
    orbits, _ = followed(name, "shooting")
    motions, _ = followed(name, "balance")
    energies = np.array([point.energy for point in orbits.regular()])
    frequencies = np.array([point.frequency for point in orbits.regular()])
    if np.any(np.diff(energies) < 0):
        return
    for point in motions.regular():
        if energies[0] < point.energy < energies[-1]:
            expected = np.interp(point.energy, energies, frequencies)
            assert point.frequency == pytest.approx(expected, rel=0.01)
