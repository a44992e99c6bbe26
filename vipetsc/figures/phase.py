"""Phase portraits of the first site's host and resonator, and of their relative motion."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.interpolate import CubicHermiteSpline

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.panels import centred_limits, empty_figure, panel_title
from vipetsc.io.read import field_time, leading_site

REFINE = 4  # points drawn for each sample


def phase(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Velocity against displacement at the first site: grey before the first contact, then by time."""
    site = leading_site(run)
    if site is None:
        return empty_figure("Phase portraits: the lattice has no contact sites")
    cell, clearance = int(run["sites/cell"][site]), 1e3 * float(run["sites/clearance"][site])
    if cell not in run["cell"].values:
        return empty_figure(f"Phase portraits: cell {cell}, the first site, was not recorded")
    if "displacement" not in run or "velocity" not in run:
        return empty_figure("Phase portraits: they need displacement and velocity, and one was not recorded")
    pair, motion = Case.of(run).model().chain.cell, run.sel(cell=cell)
    u, v, time = refined(motion["displacement"].values, motion["velocity"].values, field_time(run))
    onsets = run["impacts/onset"].values[run["impacts/site"].values == site + 1]
    first = onsets.min(initial=np.inf)

    figure = style.new_figure(style.PAGE, 2.4)
    panels = figure.subplots(1, 3)
    norm = Normalize(first if len(onsets) else time[0], time[-1])
    h, r = pair.host, pair.resonator
    portraits = (
        (u[:, h], v[:, h], "(a) Host", "u_h"),
        (u[:, r], v[:, r], "(b) Resonator", "u_r"),
        (u[:, r] - u[:, h], v[:, r] - v[:, h], "(c) Relative motion", "w"),
    )
    for axes, (x, y, title, symbol) in zip(panels, portraits, strict=True):
        after = _trajectory(axes, 1e3 * x, y, time, first, norm)
        axes.set(xlabel=f"${symbol}$ (mm)", ylabel=rf"$\dot{{{symbol}}}$ (m/s)")
        panel_title(axes, f"{title}, cell {cell}")
    relative = panels[2]
    wide = max(relative.get_xlim()[1], 1.15 * clearance)
    relative.set_xlim(-wide, wide)
    for wall in (-clearance, clearance):
        relative.axvline(wall, color=style.VERMILION, lw=0.8, ls=style.DASHED)
    relative.annotate("clearance", (clearance, 1), (-2, -2), xycoords=("data", "axes fraction"), color=style.VERMILION,
                      textcoords="offset points", ha="right", va="top", fontsize=6.5)  # fmt: skip
    if len(onsets):
        figure.colorbar(after, ax=panels, label="Time (s)", pad=0.01)
    else:
        relative.text(0.5, 0.03, "no contact", ha="center", color=style.GREY, transform=relative.transAxes)
    return figure


def refined(u: np.ndarray, v: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement, velocity and time on a finer grid, so that fast turns at the stops are not polygons."""
    if len(time) < 2:
        return u, v, time
    fine = np.interp(np.arange((len(time) - 1) * REFINE + 1) / REFINE, np.arange(len(time)), time)
    motion = CubicHermiteSpline(time, u, v, axis=0)
    return motion(fine), motion(fine, 1), fine


def _trajectory(
    axes: Axes, x: np.ndarray, y: np.ndarray, time: np.ndarray, first: float, norm: Normalize
) -> LineCollection:
    """The motion ``x``, ``y`` (t): grey up to the ``first`` contact, in the colours of ``norm`` from there."""
    before = int(np.searchsorted(time, first))
    points = np.stack([x, y], axis=1)
    segments = np.stack([points[:-1], points[1:]], axis=1)[before:]
    lines = LineCollection(list(segments), array=time[before:-1], norm=norm, cmap="viridis", lw=0.4, rasterized=True)
    axes.add_collection(lines)
    axes.plot(x[: before + 1], y[: before + 1], color=style.GREY, lw=0.4, rasterized=True)
    centred_limits(axes, x, y, 1.06)
    return lines
