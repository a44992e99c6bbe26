"""The curve of a branch as it is drawn: smooth through its points, coloured by stability; lowest states, losses.

A branch is a curve of periodic motions over their energy E (J) and frequency f (Hz), in the order in which it was
followed: several points may have one energy. The file has its tangent as dT/ds, of the period T, and the slope df/dE.
"""

from itertools import pairwise

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from vipetsc.figures import style
from vipetsc.figures.panels import annotate_empty

# Points of the curve drawn for each step of a branch. A step turns by about 0.2 rad at most (``nnm.guards``): the
# corners between its eight chords are 0.025 rad, which no eye sees.
FINE = 8
# Room above and below the curve of the damping ratio: this fraction of its range, and at least this fraction of its
# largest value, since without contact the ratio is constant but for rounding.
ROOM = 0.1
LEAST_ROOM = 0.1


def smooth(branch: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return energies in J and frequencies in Hz (point,), ``FINE`` a step, on a smooth curve through the points.

    Each step is a cubic Hermite curve in the plane of ln E and ln f, both divided by their ranges; its tangents are
    those of the branch, as long as the chord. Where a contact grazes, the branch may have a corner: the curves on both
    sides have different tangents there. Branches of fewer than three points, or without tangents, come back as they
    are.
    """
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    if len(energy) < 3 or "tangent_period" not in branch:
        return energy, frequency

    points = np.log(np.column_stack([energy, frequency]))
    # Divided by their ranges: the energy ranges much farther, and would set the direction of all chords alone.
    extent = np.ptp(points, axis=0)
    scale = np.where(extent > 0, extent, 1)
    points /= scale
    chords = np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(chords, axis=1), 1e-300)[:, None]
    unit_chord = chords / length
    begin, end = _end_tangents(branch, scale, unit_chord)

    # p(t) = p_0 + (3 t^2 - 2 t^3) (p_1 - p_0) + L [t (1 - t)^2 b - t^2 (1 - t) e] with unit tangents b and e, chord L,
    # an array (FINE, step, 2). It becomes one list of points, which ends with the last one of the branch.
    t = (np.arange(FINE) / FINE)[:, None, None]
    cubic = points[:-1] + t**2 * (3 - 2 * t) * chords + length * (t * (1 - t) ** 2 * begin - t**2 * (1 - t) * end)
    fine = np.vstack([cubic.swapaxes(0, 1).reshape(-1, 2), points[-1:]])
    fine_energy, fine_frequency = np.exp(fine * scale).T
    return fine_energy, fine_frequency


def _end_tangents(branch: xr.Dataset, scale: np.ndarray, unit_chord: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit tangents (step, 2) at the beginning and the end of every step, in (ln E, ln f) over ``scale``."""
    energy = branch["energy"].values
    frequency = branch["frequency"].values

    # The file has dT/ds and df/dE, so df/ds = -f^2 dT/ds, and dE/ds = (df/ds) / (df/dE). This is 0/0 at a frequency
    # fold and where the branch is linear: such tangents are left to ``_completed``.
    rate = -branch["tangent_period"].values * frequency**2
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.column_stack([rate / branch["slope"].values / energy, rate / frequency])
    tangents /= scale
    tangents[~np.isfinite(tangents).all(axis=1) | ~tangents.any(axis=1)] = np.nan
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]

    # All tangents point in the direction in which the branch was followed; the points may be listed the other way
    # round.
    tangents *= np.sign(np.nansum(tangents[:-1] * unit_chord)) or 1.0

    # At a grazing point the tangent is that of one side: neither step takes it.
    begin = tangents[:-1].copy()
    end = tangents[1:].copy()
    begin[branch["kind"].values[:-1] == "grazing"] = np.nan
    end[branch["kind"].values[1:] == "grazing"] = np.nan
    return _completed(begin, end, unit_chord), _completed(end, begin, unit_chord)


def _completed(tangent: np.ndarray, other: np.ndarray, unit_chord: np.ndarray) -> np.ndarray:
    """Return the ``tangent`` (step, 2) at one end of every step, completed where it is NaN.

    If the tangent ``other`` at the other end is known, the step becomes a parabola, whose two tangents have the chord
    as their mean; if not, it becomes straight.
    """
    by_other = np.where(np.isnan(other), unit_chord, 2 * unit_chord - other)
    return np.where(np.isnan(tangent), by_other, tangent)


def lowest(branch: xr.Dataset) -> np.ndarray:
    """Return for each point (point,) whether its frequency is the lowest that the branch has at its energy."""
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    order = np.argsort(energy)
    ranks = np.searchsorted(energy[order], energy)

    # Each step of the branch is a straight line over energy; points of these energies above it are not the lowest.
    least = frequency[order].copy()
    for i, (rank, next_rank) in enumerate(pairwise(ranks)):
        between = slice(min(rank, next_rank) + 1, max(rank, next_rank))
        ends = i + np.argsort(energy[i : i + 2])
        on_line = np.interp(energy[order[between]], energy[ends], frequency[ends])
        least[between] = np.minimum(least[between], on_line)
    # A point with the energy of an end of a step is compared with that end, up to the rounding of the interpolation.
    return frequency <= least[np.argsort(order)] * (1 + 1e-9)


def draw_branch(axes: Axes, branch: xr.Dataset, width: float = 1.1) -> None:
    """Draw the whole branch as stable; over it what is unstable, and where no multiplier was computed.

    A point is unstable if its largest multiplier is beyond the threshold that the file has with it. A step between a
    stable and an unstable point is drawn as stable.
    """
    energy, frequency = smooth(branch)
    multiplier = branch["multiplier_max"].values
    unstable_beyond = branch["multiplier_max"].attrs["unstable_beyond"]
    stable_label = "stable" if np.any(multiplier <= unstable_beyond) else None
    # The whole branch first, so that no gap opens between a stable part and an unstable one.
    axes.plot(energy, frequency, lw=width, zorder=2, label=stable_label, **style.CURVES["stable"])

    parts = ((multiplier > unstable_beyond, "unstable"), (np.isnan(multiplier), "not computed"))
    for is_part, label in parts:
        if len(energy) > len(is_part):
            # The curve has been smoothed: the points of a step, and the one at its end, belong to the part if both ends
            # of the step do.
            step_is_part = np.repeat(is_part[:-1] & is_part[1:], FINE)
            is_part = np.append(step_is_part, False) | np.append(False, step_is_part)
        if is_part.any():
            look = {"lw": 1.3 * width, "zorder": 3, "label": label, **style.CURVES[label]}
            axes.plot(energy, np.where(is_part, frequency, np.nan), **look)


def draw_losses(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the damping ratio of a ``branch`` over the energy (J), and the force in resonance (N) on an axis of its own.

    The force is that of the drive that makes up for the losses, if the file has it.
    """
    if "damping_ratio" not in branch:
        annotate_empty(axes, "nothing dissipates")
        return
    energy = branch["energy"].values
    # A curve of one point is no line.
    marker = "." if len(energy) == 1 else ""

    ratio = branch["damping_ratio"].values
    axes.plot(energy, ratio, lw=1.0, marker=marker, label="damping ratio", **style.CURVES["damping_ratio"])
    axes.set(xscale="log", ylabel="damping ratio")
    room = max(ROOM * float(np.ptp(ratio)), LEAST_ROOM * float(ratio.max()))
    if np.isfinite(room) and room > 0:
        axes.set_ylim(ratio.min() - room, ratio.max() + room)
    if "force" not in branch or not np.isfinite(branch["force"].values).any():
        return

    force_axes = axes.twinx()
    force_axes.plot(energy, branch["force"].values, lw=1.0, marker=marker, **style.CURVES["force"])
    force_axes.set(yscale="log", ylabel="force in resonance (N)")
    # An empty curve for the legend, which is one for both axes.
    axes.plot([], [], lw=1.0, label="force", **style.CURVES["force"])
    axes.legend(fontsize=5.5)
