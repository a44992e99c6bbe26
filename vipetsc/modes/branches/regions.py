"""Regions of a backbone, from the first contact to the smooth limit, and the power laws of its slope in them."""

import numpy as np

from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.point import POINT_VARIABLES, Point
from vipetsc.spectra import doubt, power_law

# The paper names the regions and gives no bounds: the next three numbers are choices of this package.
#
# Fraction of the time in contact from which the clearance counts as negligible (region IV). With 0.90 or 0.98 region IV
# begins at 1/6 of the energy or at 11 times the energy.
SMOOTH_LIMIT = 0.95
# Change of the slope's local exponent per e-fold of energy below which the grazing peak is over (region III).
SETTLED = 0.5
# Local exponents below this still belong to the fall from the grazing peak; no limit law is so steep. Values from -3 to
# -1.5 give the same regions.
STEEP = -2.0
# Points that a local exponent needs, and a power law.
FEWEST = 5
FEWEST_OF_A_LAW = 4
# Largest E df/dE in Hz of a branch that is linear.
LINEAR = 1e-6
# Factors of power laws stay below this and above its inverse.
MOST = float(np.exp(500.0))


def quantity(branch: Branch[Point], name: str) -> np.ndarray:
    """Return one of ``POINT_VARIABLES`` of every point (points,)."""
    return branch.column(name).astype(POINT_VARIABLES[name][1])


def regions(branch: Branch[Point]) -> np.ndarray:
    """Return the region of every point of a branch (points,), see ``assign_regions``."""
    return assign_regions(
        energy=quantity(branch, "energy"),
        slope=quantity(branch, "slope"),
        episodes=quantity(branch, "episodes"),
        closed=quantity(branch, "closed"),
    )


def slope_laws(branch: Branch[Point]) -> dict[str, dict[str, float]]:
    """Return power laws of the slope over the energy in regions II (where it falls), III and IV, see ``fit_slope``."""
    regular = branch.is_kind("regular")
    energy = quantity(branch, "energy")
    slope = quantity(branch, "slope")
    return fit_slope(energy[regular], slope[regular], regions(branch)[regular])


def tongues(branch: Branch[Point]) -> list[int]:
    """Return k of the k:1 internal resonances whose tongues a branch passes, each with an energy fold at its tip."""
    return sorted({p.resonance for p in branch.points} - {0, 1})


def assign_regions(energy: np.ndarray, slope: np.ndarray, episodes: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Return region 1-4 of every point of a branch (points,), in its order; 0 for a nonlinear branch without contacts.

    I: no contact. II: grazing, from the first contact over the peak of the slope until its steep fall has ended:
    until the local exponent d ln(df/dE)/d ln E changes by less than ``SETTLED`` per e-fold of energy and is above
    ``STEEP``. III: vibro-impact. IV: smooth limit, from the first point at which a contact is closed for the fraction
    ``SMOOTH_LIMIT`` of the time. A branch on which the slope keeps changing sign (internal resonances) has its peak
    after its last energy fold. Without an exponent that settles, II lasts. ``energy`` in J, ``slope`` in Hz/J,
    ``episodes`` contact episodes of the arc, ``closed`` the fraction of the time with a contact closed.
    """
    region = np.ones(len(energy), np.int8)
    touched = np.nonzero(episodes > 0)[0]
    if not touched.size:
        is_nonlinear = np.nanmax(np.abs(slope) * energy, initial=0.0) > LINEAR
        if is_nonlinear:
            region[:] = 0
        return region
    region[touched[0] :] = 2

    peak = _peak(energy, slope, touched[0])
    if peak is None:
        return region
    logarithm = np.log(energy[peak:])
    # At the peak itself the differences are one-sided: it is left out below.
    exponent = np.gradient(np.log(slope[peak:]), logarithm)
    growth = np.gradient(exponent, logarithm)
    settled = np.nonzero((np.abs(growth[1:]) <= SETTLED) & (exponent[1:] >= STEEP))[0]
    if not settled.size:
        return region

    third = peak + 1 + settled[0]
    region[third:] = 3
    smooth_limit = np.nonzero(closed[third:] >= SMOOTH_LIMIT)[0]
    if smooth_limit.size:
        region[third + smooth_limit[0] :] = 4
    return region


def _peak(energy: np.ndarray, slope: np.ndarray, first: int) -> int | None:
    """Return the point of the largest slope after the last energy fold beyond the ``first`` contact.

    None where the slope changes its sign after it, or too few points follow for an exponent.
    """
    start = first
    folds = np.nonzero(np.diff(np.sign(np.diff(energy[first:]))) != 0)[0]
    if folds.size:
        # A second difference belongs to three points: two further on, the fold is passed.
        start += folds[-1] + 2
    tail = slope[start:]
    if len(tail) < FEWEST or not np.all(np.isfinite(tail) & (tail > 0)):
        return None
    peak = start + int(np.argmax(tail))
    if len(energy) - peak < FEWEST:
        return None
    return peak


def fit_slope(energy: np.ndarray, slope: np.ndarray, region: np.ndarray) -> dict[str, dict[str, float]]:
    """Return df/dE = factor E^exponent in regions II (its falling part), III and IV, where it is without ``doubt``.

    ``energy`` in J, ``slope`` df/dE in Hz/J and ``region``, 1 to 4, are arrays (point,) along the branch. A vertical
    piece of a branch has no law: its factor leaves the range of numbers, or its adjusted R^2 is NaN.
    """
    laws = {}
    for number, label in ((2, "II"), (3, "III"), (4, "IV")):
        e = energy[region == number]
        s = slope[region == number]
        if number == 2:
            peak = _last_peak(s)
            e = e[peak:]
            s = s[peak:]
        usable = np.isfinite(s) & (s > 0) & (e > 0)
        if usable.sum() < FEWEST_OF_A_LAW or np.ptp(e[usable]) == 0:
            continue

        law = power_law(e[usable], s[usable])
        if doubt(usable.sum(), law.r2_adjusted) or not 1 / MOST <= law.factor <= MOST:
            continue
        laws[label] = {
            "exponent": law.exponent,
            "factor": law.factor,
            "adjusted_r2": law.r2_adjusted,
            "points": int(usable.sum()),
        }
    return laws


def _last_peak(slope: np.ndarray) -> int:
    """Return the place of the largest slope after the last that is not positive."""
    begin = 0
    backwards = np.nonzero(~(slope > 0))[0]
    if backwards.size:
        begin = int(backwards[-1]) + 1
    # None may follow: the largest of nothing is not defined.
    if begin == len(slope):
        return begin
    return begin + int(np.argmax(slope[begin:]))
