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
from vipetsc.lattice import Chain, UnitCell, Waveform, nonlinear_places
from vipetsc.lattice.chain import Ends
from vipetsc.modes.shooting.dop853_step import STAGES

# Errors are relative to the largest value so far, and to this fraction of the linear wave's size at least. Derivatives
# by a clearance are zero up to an onset, after which their acceleration grows, by Hertz's law, as the root of the time.
# Without the floor an error would be relative to values near zero, and no step would be short enough.
FLOOR = 1e-2


class MotionError(RuntimeError):
    """A motion that could not be followed to its end."""


class MotionCoefficients(NamedTuple):
    """The coefficients of a model's equations of motion, in arrays of which differences can be taken.

    ``masses`` (n,) in kg. The matrices of ``stiffness`` in N/m and ``damping`` in N s/m have one pattern: the entries
    (entry,) of row i have the numbers ``first[i]`` to ``first[i + 1]``, and ``columns`` (entry,) their columns.
    ``sites`` (site,) are of dtype ``SITE``; ``gains`` (drive,) are the amplitudes of the drives' forces, in N.
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
        # Trial cases differ in their contacts more often than in their cells: the matrices of equal cells are kept. A
        # lattice whose cells differ is described by arrays, which cannot be keys of a cache.
        if chain.variation is None:
            matrices = _matrices_of_equal_cells(chain.cell, chain.cells, chain.ends)
        else:
            matrices = _matrices(chain)
        return cls(*matrices, sites=site_records(model, np.arange(len(chain.sites))), gains=gains_of(model))


class MatrixEntries(NamedTuple):
    """Masses, stiffness and damping of a lattice, as in ``MotionCoefficients``."""

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

    # One pattern for both matrices, their places numbered row by row: those of springs, dashpots and the diagonal.
    diagonal = np.arange(n) * (n + 1)
    places = [matrix.rows * n + matrix.columns for matrix in matrices]
    pattern = np.unique(np.concatenate([*places, diagonal]))
    values = []
    for matrix, place in zip(matrices, places, strict=True):
        sums = np.bincount(np.searchsorted(pattern, place), matrix.values, len(pattern))
        # NumPy sums no entries at all, as those of a cell without springs, to integers.
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
    """The amplitudes (drive,) in N of the drives' forces: that of a moved wall times the stiffness of its spring."""
    return np.array([drive.waveform.amplitude * (drive.stiffness or 1.0) for drive in model.drives])


def no_slopes(model: Model, middle: MotionCoefficients) -> Slopes:
    """The derivatives of ``middle``, the coefficients of ``model``, by a parameter on which none depends: zeros.

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
    """Derivatives of ``middle``, the coefficients of ``model``, by the difference between two other models.

    ``width`` is the distance of the parameter, or of its coordinate, in ``low`` and ``high``. Arrays have no axis of
    parameters.
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

    # Derivatives of a drive's force are that force times these numbers: they are relative to the amplitude.
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
    """Derivatives by a parameter that are ``factor`` times ``slopes``; ``linear``, which is no number, stays."""
    scaled = {name: factor * array for name, array in slopes._asdict().items() if name != "linear"}
    return slopes._replace(**scaled)


def stacked_slopes(rows: Sequence[Slopes], none: Slopes) -> Slopes:
    """The derivatives ``rows``, one for each parameter, in arrays whose first axis is that of parameters.

    ``none`` are those of ``no_slopes``: without a parameter they give the arrays their shapes.
    """
    stacked = (np.stack(arrays) for arrays in zip(none, *rows, strict=True))
    return Slopes(*(array[1:] for array in stacked))


class RecordedMotion(NamedTuple):
    """A motion at samples.

    ``motion`` (sample, watched mass, 4, column): u, u', u'' in m, m/s, m/s^2, and in column 0 also u''' in m/s^3.
    Column 0 is the motion, column 1 + p its derivative with respect to parameter p. ``episodes`` (episode,) are the
    contacts, of dtype ``EPISODE``; ``reached`` (site, 2) the largest w and -w in m at ends of steps, at least 0.
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

    ``coefficients`` are the model's, ``slopes`` their derivatives by the parameters. The motion starts as ``begin``
    says, by default from rest at t = 0. ``watched`` (mass,) are the masses that are sampled, 0-based and cell by cell.
    Without ``touches`` no site ever closes. Raises MotionError if it cannot be followed to the last time.
    """
    chain = model.chain
    # A copy: the motion sets the modes of its sites, and the coefficients stay as they are.
    sites = coefficients.sites.copy()
    if not touches:
        sites["clearance"] = sites["clearance_minus"] = np.inf
    drives = create_drives(model.drives, range(len(model.drives)))
    for row, drive in zip(drives.rows, model.drives, strict=True):
        row["target"] = drive.cell * chain.cell.dofs + drive.mass
        # The rate of the force is a difference over a time in which no part of it turns.
        row["highest"] = fastest_of(drive.waveform)

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

    tracker = ImpactTracker(sites, range(len(sites)))
    moving = create_motion(
        rows=2 * len(coefficients.masses),
        columns=1 + len(slopes.linear),
        sites=len(sites),
        scale=model.scale,
        tolerances=tolerances,
    )
    instant = 0.0
    if begin is not None:
        instant = begin.time
        moving.state[:, 0] = begin.state
        moving.state[:, 1:] = begin.slopes
        begin_contacts(lattice, moving, tracker)
    # Times of every n-th sample are not contiguous, and for arrays of another layout the kernels would be compiled
    # once more.
    instants = np.ascontiguousarray(times)
    # The highest frequency, the first instant, then those of the samples.
    outcome, tracks, motion, reached = integrate(
        lattice, moving, tracker.tracks, fastest(coefficients), instant, instants, watched
    )
    if outcome != DONE:
        raise MotionError("the steps of the integration became too small")
    tracker.tracks = tracks
    episodes = tracker.take_episodes(np.zeros(len(sites)), unfinished=True)
    return RecordedMotion(motion, np.sort(episodes, order=("onset", "site")), reached)


def fastest_of(waveform: Waveform) -> float:
    """The frequency in rad/s of the fastest part of a ``waveform``; of polynomials, which have none, the main one."""
    return waveform.highest or waveform.frequency


def _curved_springs(chain: Chain, slopes: Slopes) -> CurvedSprings:
    """The springs of ``chain`` with a quadratic or cubic part, or whose quadratic or cubic part is sought."""
    has_slope = slopes.curves.any(axis=(0, 2))
    places = nonlinear_places(chain, also=np.flatnonzero(has_slope).tolist())
    return CurvedSprings(
        ends=np.array([(place.start, place.end) for place in places], np.int64).reshape(-1, 2),
        numbers=np.array([place.number for place in places], np.int64),
        laws=spring_laws([place.law for place in places]),
    )


def create_motion(rows: int, columns: int, sites: int, scale: float, tolerances: Tolerances = EXACT) -> MotionState:
    """The state of rest and the workspace of a motion with so many ``rows``, 2n, ``columns`` and ``sites``.

    ``scale`` in m is the size of the linear wave.
    """
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
    """An upper bound in rad/s of the frequencies of the lattice without contacts."""
    # No eigenvalue of a symmetric matrix exceeds the largest sum of magnitudes in a row (Gershgorin). The matrix is
    # K_ij/(m_i m_j)^(1/2), whose eigenvalues are the squared frequencies.
    rows = np.repeat(np.arange(len(coefficients.masses)), np.diff(coefficients.first))
    inverse = 1 / coefficients.masses
    weights = abs(coefficients.stiffness) * np.sqrt(inverse[rows] * inverse[coefficients.columns])
    return float(np.sqrt(np.bincount(rows, weights, len(inverse)).max()))
