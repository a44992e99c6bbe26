"""Regions I-IV of a backbone, found from the branch itself, and the power laws of its slope."""

from __future__ import annotations

import numpy as np

from vipetsc.spectra import PowerLaw, power_law

SMOOTH_LIMIT = 0.95
"""Fraction of the time in contact from which the clearance counts as negligible (region IV)."""


SETTLED = 0.5
"""Change of the slope's local exponent per e-fold of energy below which the grazing peak is over (region III)."""

STEEPEST = 500.0
"""|ln factor| of a power law above which it stands for a vertical piece of the branch."""

STEEP = -2.0
"""Local exponents below this still belong to the fall from the grazing peak; no limit law is so steep."""


def regions(energy: np.ndarray, slope: np.ndarray, episodes: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Region 1-4 of every point of a branch (points,), in its order; 0 for a nonlinear branch without contacts.

    I: no contact. II: grazing, from the first contact over the peak of the slope until its steep fall has ended:
    until the local exponent d ln(df/dE)/d ln E changes by less than ``SETTLED`` per e-fold of energy and is above
    ``STEEP``. III: vibro-impact. IV: smooth limit, from where a contact is closed for 95 % of the time on. A
    branch on which the slope keeps changing sign (internal resonances) has its peak after its last energy fold.
    Without an exponent that settles, II lasts.

    Parameters
    ----------
    energy, slope
        J and Hz/J.
    episodes, closed
        Contact episodes of the arc, and the fraction of the time with a contact closed.
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
    tail = slice(start, None)
    usable = np.isfinite(slope[tail]) & (slope[tail] > 0)
    if usable.sum() < 5 or not usable.all():
        return region
    start += int(np.argmax(slope[tail]))
    if len(energy) - start < 5:
        return region
    exponent = np.gradient(np.log(slope[start:]), np.log(energy[start:]))
    growth = np.gradient(exponent, np.log(energy[start:]))
    settled = np.nonzero((np.abs(growth[1:]) <= SETTLED) & (exponent[1:] >= STEEP))[0]
    if settled.size:
        region[start + 1 + settled[0] :] = 3
        smooth = np.nonzero(closed[start + 1 + settled[0] :] >= SMOOTH_LIMIT)[0]
        if smooth.size:
            region[start + 1 + settled[0] + smooth[0] :] = 4
    return region


def slope_law(energy: np.ndarray, slope: np.ndarray) -> PowerLaw | None:
    """df/dE as a power law of E over the usable points, None where it is not one: fewer than 4, or a vertical piece."""
    usable = np.isfinite(slope) & (slope > 0) & (energy > 0)
    if usable.sum() < 4 or np.ptp(energy[usable]) == 0:
        return None
    law = power_law(energy[usable], slope[usable])
    with np.errstate(divide="ignore"):
        vertical = abs(np.log(law.factor)) > STEEPEST
    return None if vertical or np.isnan(law.r2_adjusted) else law
