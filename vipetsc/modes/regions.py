"""Regions I-IV of a backbone, told from the branch itself, and the power laws of its slope."""

import numpy as np

from vipetsc.spectra import power_law

# Fraction of the time in contact from which the clearance counts as negligible (region IV).
SMOOTH_LIMIT = 0.95
# Change of the slope's local exponent per e-fold of energy below which the grazing peak is over (region III).
SETTLED = 0.5
# Local exponents below this still belong to the fall from the grazing peak; no limit law is so steep.
STEEP = -2.0
# Points that a local exponent needs.
FEWEST = 5
# Factors of power laws stay below this and above its inverse.
MOST = float(np.exp(500.0))


def tell_regions(energy: np.ndarray, slope: np.ndarray, episodes: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Region 1-4 of every point of a branch (points,), in its order; 0 for a nonlinear branch without contacts.

    I: no contact. II: grazing, from the first contact over the peak of the slope until its steep fall has ended:
    until the local exponent d ln(df/dE)/d ln E changes by less than ``SETTLED`` per e-fold of energy and is above
    ``STEEP``. III: vibro-impact. IV: smooth limit, from where a contact is closed for 95 % of the time on. A
    branch on which the slope keeps changing sign (internal resonances) has its peak after its last energy fold.
    Without an exponent that settles, II lasts. ``energy`` in J, ``slope`` in Hz/J, ``episodes`` contact episodes of the
    arc, ``closed`` the fraction of the time with a contact closed.
    """
    region = np.ones(len(energy), np.int8)
    touched = np.nonzero(episodes > 0)[0]
    if not touched.size:
        smooth = np.nanmax(np.abs(slope) * energy, initial=0.0) > 1e-6
        return region * (0 if smooth else 1)
    first = touched[0]
    region[first:] = 2
    folds = np.nonzero(np.diff(np.sign(np.diff(energy[first:]))) != 0)[0]
    start = first + (folds[-1] + 2 if folds.size else 0)
    tail = slope[start:]
    if len(tail) < FEWEST or not np.all(np.isfinite(tail) & (tail > 0)):
        return region
    start += int(np.argmax(tail))
    if len(energy) - start < FEWEST:
        return region
    exponent = np.gradient(np.log(slope[start:]), np.log(energy[start:]))
    growth = np.gradient(exponent, np.log(energy[start:]))
    settled = np.nonzero((np.abs(growth[1:]) <= SETTLED) & (exponent[1:] >= STEEP))[0]
    if settled.size:
        third = start + 1 + settled[0]
        region[third:] = 3
        smooth_limit = np.nonzero(closed[third:] >= SMOOTH_LIMIT)[0]
        if smooth_limit.size:
            region[third + smooth_limit[0] :] = 4
    return region


def slope_laws(energy: np.ndarray, slope: np.ndarray, region: np.ndarray) -> dict[str, dict[str, float]]:
    """df/dE = factor E^exponent in regions II (its falling part), III and IV, where four points or more allow it.

    A vertical piece of a branch has none: its exponent leaves the range of numbers, or its adjusted R^2 is none.
    """
    laws = {}
    for number, label in ((2, "II"), (3, "III"), (4, "IV")):
        e, s = energy[region == number], slope[region == number]
        if number == 2 and e.size:
            backwards = np.nonzero(~(s > 0))[0]
            begin = backwards[-1] + 1 if backwards.size else 0
            begin += int(np.argmax(s[begin:])) if s[begin:].size else 0
            e, s = e[begin:], s[begin:]
        usable = np.isfinite(s) & (s > 0) & (e > 0)
        if usable.sum() < 4 or np.ptp(e[usable]) == 0:
            continue
        law = power_law(e[usable], s[usable])
        if np.isfinite(law.r2_adjusted) and 1 / MOST <= law.factor <= MOST:
            laws[label] = {"exponent": law.exponent, "factor": law.factor, "adjusted_r2": law.r2_adjusted}
            laws[label]["points"] = law.points
    return laws
