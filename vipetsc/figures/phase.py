"""Phase portraits of the first site's host and resonator, and of their relative motion."""

from __future__ import annotations

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.interpolate import CubicHermiteSpline

from vipetsc.figures import style
from vipetsc.io.run_file import RunFile

REFINE = 4  # points drawn for each sample


def phase(run: RunFile, analysis: h5py.File | None) -> Figure:
    """Velocity against displacement at the first site: grey before the first contact, then by time."""
    site = run.leading_site
    if site is None:
        return style.without_data("Phase portraits: the lattice has no contact sites")
    cell = run.site_cells[site]
    at = run.nearest(cell)
    if run.cells[at] != cell:
        return style.without_data(f"Phase portraits: cell {cell}, the first site, was not recorded")
    if not {"displacement", "velocity"} <= run.file.keys():
        return style.without_data("Phase portraits: they need displacement and velocity, and one was not recorded")
    pair = run.model.chain.cell
    u, v, time = refined(run.displacement[:, at], run.velocity[:, at], run.field_time)
    u = 1e3 * u
    h, r = pair.host, pair.resonator
    onsets = run.impacts["onset"][run.impacts["site"] == site + 1]
    first = onsets.min() if len(onsets) else np.inf

    figure = style.new_figure(style.PAGE, 2.4)
    panels = figure.subplots(1, 3)
    norm = Normalize(first if np.isfinite(first) else time[0], time[-1])
    portraits = (
        (u[:, h], v[:, h], "Host", "u_h"),
        (u[:, r], v[:, r], "Resonator", "u_r"),
        (u[:, r] - u[:, h], v[:, r] - v[:, h], "Relative motion", "w"),
    )
    for axes, key, (x, y, title, symbol) in zip(panels, "abc", portraits, strict=True):
        after = _trajectory(axes, x, y, time, first, norm)
        axes.set(xlabel=f"${symbol}$ (mm)", ylabel=rf"$\dot{{{symbol}}}$ (m/s)")
        style.letter(axes, f"({key}) {title}, cell {cell}")
    wide = max(panels[2].get_xlim()[1], 1.15e3 * run.clearances[site])
    panels[2].set_xlim(-wide, wide)
    for wall in (-1, 1):
        panels[2].axvline(wall * run.clearances[site] * 1e3, color=style.VERMILION, lw=0.8, ls=(0, (4, 2)))
    panels[2].annotate("clearance", (run.clearances[site] * 1e3, 1), (-2, -2), xycoords=("data", "axes fraction"),
                       textcoords="offset points", ha="right", va="top", fontsize=6.5,
                       color=style.VERMILION)  # fmt: skip
    if np.isfinite(first):
        figure.colorbar(after, ax=panels, label="Time (s)", pad=0.01)
    else:
        panels[2].text(0.5, 0.03, "no contact", ha="center", color=style.GREY, transform=panels[2].transAxes)
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
    before = int(np.searchsorted(time, first))
    points = np.stack([x, y], axis=1)
    segments = np.stack([points[:-1], points[1:]], axis=1)
    lines = LineCollection(segments[before:], array=time[before:-1], norm=norm, cmap="viridis", lw=0.4, rasterized=True)
    axes.add_collection(lines)
    axes.plot(x[: before + 1], y[: before + 1], color=style.GREY, lw=0.4, rasterized=True)
    for set_limits, values in ((axes.set_xlim, x), (axes.set_ylim, y)):
        reach = 1.06 * np.abs(values).max() or 1.0
        set_limits(-reach, reach)
    return lines
