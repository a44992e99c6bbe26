"""Damping of nonlinear normal modes over their energy, and the force that makes up for it."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from vipetsc.figures import style
from vipetsc.figures.panels import annotate_empty

# Room above and below the curve of the damping ratio: this fraction of its range, and at least this fraction of its
# largest value, since without contact the ratio is constant but for rounding.
ROOM = 0.1
LEAST_ROOM = 0.1


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
