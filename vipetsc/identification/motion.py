"""The motion of a lattice with its derivatives: coefficients from models, and the call of the kernels.

``motion_rates`` has the equations, ``motion_steps`` their integration, ``motion_begin`` the contacts that are closed
when the motion begins; the docstring of the package derives them.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.case import Model
from vipetsc.contact.tracker import ImpactTracker
from vipetsc.dynamics.drives import create_drives
from vipetsc.dynamics.site_dofs import site_records
from vipetsc.dynamics.spring_law import spring_laws
from vipetsc.identification.motion_begin import MotionBegin, begin_contacts
from vipetsc.identification.motion_rates import CurvedSprings, Lattice, MotionState, Slopes
from vipetsc.identification.motion_steps import DONE, integrate
from vipetsc.identification.precision import EXACT, Tolerances
from vipetsc.lattice import Chain, UnitCell, nonlinear_places
from vipetsc.lattice.chain import Ends
from vipetsc.modes.shooting.dop853 import STAGES

# Errors are relative to the largest value so far, and to this fraction of the linear wave at least. Derivatives by a
# clearance are zero up to an onset; behind it their acceleration grows as the root of time, by Hertz's law, and no step
# would resolve that relative to values near zero.
FLOOR = 1e-2


class MotionError(RuntimeError):
    """A motion that could not be followed to its end."""


class MotionCoefficients(NamedTuple):
    """The coefficients of a model's equations of motion, in arrays that can be differenced.

    ``masses`` (n,) in kg; ``stiffness`` and ``damping`` (entry,) in N/m and N s/m, over the pattern ``first`` (n + 1,)
    and ``columns`` (entry,) of both; ``sites`` (site,) of dtype ``SITE``; ``gains`` (drive,) of the drives, in N.
    """

    masses: np.ndarray
    first: np.ndarray
    columns: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    sites: np.ndarray
    gains: np.ndarray

    @classmethod
    def of(cls, model: Model) -> "MotionCoefficients":
        """The coefficients of a ``model``."""
        chain = model.chain
        # Trial cases differ in their contacts more often than in their cells. Cells that vary are never sought, and
        # arrays that vary cannot be looked up.
        matrices = _matrices(chain)
        if chain.variation is None:
            matrices = _matrices_of_equal_cells(chain.cell, chain.cells, chain.ends)
        return cls(*matrices, sites=site_records(model, np.arange(len(chain.sites))), gains=gains_of(model))


class MatrixEntries(NamedTuple):
    """Masses, stiffness and damping of a lattice, as of ``MotionCoefficients``."""

    masses: np.ndarray
    first: np.ndarray
    columns: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


def _matrices(chain: Chain) -> MatrixEntries:
    """The matrices of a ``chain``, whose contacts have no part in them."""
    matrices = (chain.stiffness_entries(), chain.damping_entries())
    masses = chain.masses()
    n = len(masses)

    # One pattern for both matrices: places are numbered row by row, and the springs have every place of a dashpot
    # between masses.
    diagonal = np.arange(n) * (n + 1)
    places = [matrix.rows * n + matrix.columns for matrix in matrices]
    pattern = np.unique(np.concatenate([*places, diagonal]))
    values = []
    for matrix, place in zip(matrices, places, strict=True):
        sums = np.bincount(np.searchsorted(pattern, place), matrix.values, len(pattern))
        # Sums of no entries, as of a cell without springs, are integers.
        values.append(sums.astype(float))
    return MatrixEntries(
        masses=masses,
        first=np.searchsorted(pattern, np.arange(n + 1) * n),
        columns=pattern % n,
        stiffness=values[0],
        damping=values[1],
    )


@lru_cache(maxsize=64)
def _matrices_of_equal_cells(cell: UnitCell, cells: int, ends: Ends) -> MatrixEntries:
    """The matrices of a lattice of equal cells; nothing changes them."""
    return _matrices(Chain(cell, cells, ends))


def gains_of(model: Model) -> np.ndarray:
    """The amplitudes (drive,) in N of the drives, those of a wall's motion times the stiffness of its spring."""
    return np.array([drive.waveform.amplitude * (drive.stiffness or 1.0) for drive in model.drives])


def no_slopes(model: Model, middle: MotionCoefficients) -> Slopes:
    """The derivatives of ``middle``, the coefficients of ``model``, by a parameter on which none of them depends.

    Arrays have no axis of parameters.
    """
    sites = len(middle.sites)
    return Slopes(
        masses=np.zeros(len(middle.masses)),
        stiffness=np.zeros(len(middle.stiffness)),
        damping=np.zeros(len(middle.damping)),
        gaps=np.zeros((sites, 2)),
        laws=np.zeros((sites, 3)),
        drives=np.zeros(len(middle.gains)),
        curves=np.zeros((len(model.chain.cell.springs), 2)),
        linear=np.array(False),
    )


def slopes_between(low: Model, high: Model, width: float, model: Model, middle: MotionCoefficients) -> Slopes:
    """Derivatives of ``middle``, the coefficients of ``model``, by central differences between two models.

    ``width`` is the distance of the parameter, or of its coordinate, in ``low`` and ``high``. Coefficients are affine
    in most parameters and smooth in the others, so that no truncation is seen. Arrays have no axis of parameters.
    """
    slopes = no_slopes(model, middle)
    # Matrices take most of the time, and contacts have no part in them.
    if low.chain.cell != high.chain.cell:
        before = MotionCoefficients.of(low)
        after = MotionCoefficients.of(high)
        slopes.masses[:] = (after.masses - before.masses) / width
        slopes.stiffness[:] = (after.stiffness - before.stiffness) / width
        slopes.damping[:] = (after.damping - before.damping) / width
        laws = [spring_laws(at.chain.cell.springs) for at in (low, high)]
        for k, name in enumerate(("quadratic", "cubic")):
            slopes.curves[:, k] = (laws[1][name] - laws[0][name]) / width
        slopes.linear[...] = True

    # Forces of drives are multiplied by a factor, so that their derivatives are relative to it.
    gains = gains_of(high) - gains_of(low)
    slopes.drives[:] = gains / width / np.where(middle.gains != 0, middle.gains, 1.0)
    sites = [site_records(at, np.arange(len(at.chain.sites))) for at in (low, high)]
    for k, name in enumerate(("clearance", "clearance_minus")):
        # Where there is no stop both are infinite.
        stops = np.isfinite(middle.sites[name])
        slopes.gaps[stops, k] = (sites[1][name][stops] - sites[0][name][stops]) / width
    for k, name in enumerate(("stiffness", "exponent")):
        slopes.laws[:, k] = (sites[1]["elastic"][name] - sites[0]["elastic"][name]) / width
    slopes.laws[:, 2] = (sites[1]["damping"] - sites[0]["damping"]) / width
    return slopes


def scaled_slopes(slopes: Slopes, factor: float) -> Slopes:
    """Derivatives by a parameter, ``factor`` times those of ``slopes``."""
    scaled = {name: factor * array for name, array in slopes._asdict().items() if name != "linear"}
    return slopes._replace(**scaled)


def stacked_slopes(rows: Sequence[Slopes], none: Slopes) -> Slopes:
    """The derivatives ``rows`` of each parameter in arrays with an axis of parameters.

    ``none`` are those of ``no_slopes``, which give the arrays their shapes where there is no parameter.
    """
    stacked = (np.stack(arrays) for arrays in zip(none, *rows, strict=True))
    return Slopes(*(array[1:] for array in stacked))


class RecordedMotion(NamedTuple):
    """A motion at samples.

    ``motion`` (sample, watched, 4, column): u, u', u'' in m, m/s, m/s^2, and u''' in column 0; column 0 is the motion,
    column 1 + p its derivative with respect to parameter p. ``episodes`` are the contacts, of dtype ``EPISODE``;
    ``reached`` (site, 2) the largest |w| in m on the sides + and -.
    """

    motion: np.ndarray
    episodes: np.ndarray
    reached: np.ndarray


def respond(
    model: Model,
    coefficients: MotionCoefficients,
    slopes: Slopes,
    times: np.ndarray,
    watched: np.ndarray,
    touches: bool = True,
    begin: MotionBegin | None = None,
    tolerances: Tolerances = EXACT,
) -> RecordedMotion:
    """The motion of ``model`` and its derivatives at the rising ``times`` (sample,) in s.

    ``coefficients`` are the model's. The motion starts as ``begin`` says, by default from rest at t = 0. ``watched``
    are masses (0-based, cell by cell); without ``touches`` no site ever closes. Raises MotionError.
    """
    chain = model.chain
    sites = coefficients.sites.copy()
    if not touches:
        sites["clearance"] = sites["clearance_minus"] = np.inf
    drives = create_drives(model.drives, range(len(model.drives)))
    for row, drive in zip(drives.rows, model.drives, strict=True):
        row["target"] = drive.cell * chain.cell.dofs + drive.mass

    ends = np.zeros((len(sites), 2), np.int64)
    for row, cell, pair in zip(ends, chain.sites, chain.contact_pairs, strict=True):
        # The ground has no row of the motion.
        row[0] = -1
        if pair.host >= 0:
            row[0] = cell * chain.cell.dofs + pair.host
        row[1] = (cell + pair.next_cell) % chain.cells * chain.cell.dofs + pair.resonator
    lattice = Lattice(
        inverse_mass=1 / coefficients.masses,
        first=coefficients.first,
        columns=coefficients.columns,
        stiffness=coefficients.stiffness,
        damping=coefficients.damping,
        curved=_curved_springs(chain, slopes),
        contacts=sites,
        ends=ends,
        drives=drives,
        slopes=slopes,
    )

    columns = 1 + len(slopes.linear)
    rows = 2 * len(coefficients.masses)
    tracker = ImpactTracker(sites, range(len(sites)))
    state = create_motion(rows, columns, len(sites), model.scale, tolerances)
    instant = 0.0
    if begin is not None:
        instant = begin.time
        state.state[:, 0] = begin.state
        state.state[:, 1:] = begin.slopes
        begin_contacts(lattice, state, tracker)
    # Kernels are compiled once for each layout of their arguments.
    instants = np.ascontiguousarray(times)
    outcome, tracks, motion, reached = integrate(
        lattice, state, tracker.tracks, fastest(coefficients), instant, instants, watched
    )
    if outcome != DONE:
        raise MotionError("the steps of the integration became too small")
    tracker.tracks = tracks
    episodes = tracker.take_episodes(np.zeros(len(sites)), unfinished=True)
    return RecordedMotion(motion, np.sort(episodes, order=("onset", "site")), reached)


def _curved_springs(chain: Chain, slopes: Slopes) -> CurvedSprings:
    """The springs of ``chain`` that have a quadratic or cubic part, or in which one is sought that is zero now."""
    has_slope = slopes.curves.any(axis=(0, 2))
    places = nonlinear_places(chain, also=np.flatnonzero(has_slope).tolist())
    return CurvedSprings(
        ends=np.array([(place.start, place.end) for place in places], np.int64).reshape(-1, 2),
        numbers=np.array([place.number for place in places], np.int64),
        laws=spring_laws([place.law for place in places]),
    )


def create_motion(rows: int, columns: int, sites: int, scale: float, tolerances: Tolerances = EXACT) -> MotionState:
    """The state of rest and the workspace of so many ``rows``, 2n, and ``columns``; ``scale`` in m is that of waves."""
    return MotionState(
        state=np.zeros((rows, columns)),
        end=np.zeros((rows, columns)),
        stages=np.zeros((STAGES, rows, columns)),
        rates=np.zeros((rows, columns)),
        estimates=np.zeros((2, rows, columns)),
        approach=np.zeros((sites, columns)),
        before=np.zeros((sites, 3)),
        after=np.zeros((sites, 3)),
        largest=np.full(columns, FLOOR * scale),
        tolerances=np.array(tolerances),
        room=np.zeros((2, 6)),
    )


def fastest(coefficients: MotionCoefficients) -> float:
    """A bound in rad/s of the fastest mode's frequency, by Gershgorin's circles."""
    rows = np.repeat(np.arange(len(coefficients.masses)), np.diff(coefficients.first))
    inverse = 1 / coefficients.masses
    weights = abs(coefficients.stiffness) * np.sqrt(inverse[rows] * inverse[coefficients.columns])
    return float(np.sqrt(np.bincount(rows, weights, len(inverse)).max()))
