"""Phase portraits: of the first site's pair in one run, and of the one contact cell at rising amplitudes."""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.interpolate import CubicHermiteSpline

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.panels import empty_figure, note, panel_title, recorded_sites
from vipetsc.figures.study import Labels, MeasuredRun, Sweeps, grouped, sites_of, transfer_members
from vipetsc.figures.transfer_curves import Curve, transfer_curves
from vipetsc.io.read import field_interval, field_time, leading_site

REFINE = 4  # points drawn for each sample
PERIODS = 10  # of the drive that a portrait shows


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
    before = int(np.searchsorted(time, first))
    for axes, (x, y, title, symbol) in zip(panels, portraits, strict=True):
        points = np.stack([1e3 * x, y], axis=1)
        segments = list(np.stack([points[:-1], points[1:]], axis=1)[before:])
        after = LineCollection(segments, array=time[before:-1], norm=norm, cmap="viridis", lw=0.4, rasterized=True)
        axes.add_collection(after)
        axes.plot(*points[: before + 1].T, color=style.GREY, lw=0.4, rasterized=True)
        _centred_limits(axes, points[:, 0], points[:, 1], 1.06)
        axes.set(xlabel=f"${symbol}$ (mm)", ylabel=rf"$\dot{{{symbol}}}$ (m/s)")
        panel_title(axes, f"{title}, cell {cell}")
    relative = panels[2]
    wide = max(relative.get_xlim()[1], 1.15 * clearance)
    relative.set_xlim(-wide, wide)
    for wall in (-clearance, clearance):
        relative.axvline(wall, color=style.VERMILION, lw=0.8, ls=style.DASHED)
    note(relative, "clearance", (clearance, 1), (-2, -2), xycoords=("data", "axes fraction"), ha="right", va="top",
         color=style.VERMILION)  # fmt: skip
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


def _centred_limits(axes: Axes, x: np.ndarray, y: np.ndarray, margin: float) -> None:
    """Limits symmetric about zero that hold ``x`` and ``y`` with a ``margin`` (a factor)."""
    for set_limits, values in ((axes.set_xlim, x), (axes.set_ylim, y)):
        reach = margin * np.abs(values).max() or 1.0
        set_limits(-reach, reach)


class ContactMotion(NamedTuple):
    """Displacement in m and velocity in m/s (t, 2) of host and resonator of the contact cell, and the transfer."""

    case: Case
    displacement: np.ndarray
    velocity: np.ndarray
    ibtet: float

    @classmethod
    def read(cls, folder: Path) -> Self:
        """The member in ``folder`` for ``PERIODS`` of the drive about its largest relative displacement."""
        with MeasuredRun.open(folder) as member:
            run, cell = member.run, member.model.chain.cell
            motion = run.sel(cell=run["sites/cell"].values[0]).isel(dof=[cell.host, cell.resonator])
            displacement, velocity = motion["displacement"].values, motion["velocity"].values
            middle = int(np.argmax(np.abs(displacement[:, 1] - displacement[:, 0])))
            half = round(PERIODS * np.pi / member.model.drive.frequency / field_interval(run))
            shown = slice(max(middle - half, 0), middle + half + 1)
            u, v, _ = refined(displacement[shown], velocity[shown], field_time(run)[shown])
            return cls(member.case, u, v, float(member.analysis["ibtet"]))


def phase_regimes(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Trajectories of one embedded contact cell, for every law and reading, beside the transfer curve."""
    members = []
    for member in transfer_members(sweeps):
        run = member.run
        if len(recorded_sites(run)) == run.sizes["site"] == 1 and "displacement" in run and "velocity" in run:
            members.append((member.case, member.folder))
    curves = list(transfer_curves(sweeps))
    for name, group in grouped(members, lambda pair: _settings(pair[0])).items():
        sites = sites_of(group[0][0])
        curve = next((c for c in curves if _settings(c.case) == name and sites_of(c.case) == sites), None)
        yield name, partial(_page, [folder for _, folder in group], curve)


def _settings(case: Case) -> str:
    return f"{case.contacts.law}-{Labels.of(case).page_stem}"


def _page(folders: Sequence[Path], curve: Curve | None) -> Figure:
    motions = sorted(map(ContactMotion.read, folders), key=lambda motion: motion.case.drive.amplitude)
    case = motions[0].case
    columns = -(-len(motions) // 2)
    labels = Labels.of(case)
    heading = f"{labels.law}, {case.lattice.reading}, {labels.configuration}, cell {sites_of(case)[0]}"
    figure = style.new_figure(style.PAGE, 3.4, heading, left=True)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 0.62 * columns))
    transfer, panels = left.subplots(), right.subplots(2, columns, squeeze=False).ravel()
    if curve is not None:
        transfer.plot(curve.data["amplitude"], curve.data["ibtet"], "-o", color=style.GREY, ms=2, lw=0.7)
    for number, (axes, motion) in enumerate(zip(panels, motions, strict=False), 1):
        point = motion.case.drive.amplitude, motion.ibtet
        transfer.plot(*point, "o", color=style.RED, ms=4, zorder=3)
        note(transfer, str(number), point, (4, 3), fontsize=7.5, color=style.RED)
        displacement = 1e3 * motion.displacement
        for j, colour in ((1, style.BLUE), (0, style.RED)):
            axes.plot(displacement[:, j], motion.velocity[:, j], color=colour, lw=0.5)
        _centred_limits(axes, displacement, motion.velocity, 1.08)
        axes.tick_params(labelsize=6, pad=1.5)
        axes.set_xlabel("$u$ (mm)", fontsize=7)
        axes.set_ylabel(r"$\dot u$ (m/s)", fontsize=7, labelpad=0)
        axes.set_box_aspect(1)
        panel_title(axes, f"{number}: {point[0]:.4g} N")
    transfer.set(xscale="log", yscale="log", xlabel="Amplitude of the drive (N)", ylabel="Inter-band transfer (1)")
    transfer.margins(x=0.08, y=0.12)
    panel_title(transfer, "Transfer to higher bands")
    for axes in panels[len(motions) :]:
        axes.set_axis_off()
    keys = [Line2D([], [], color=c, label=n) for c, n in ((style.RED, "host"), (style.BLUE, "resonator"))]
    has_room = len(motions) < len(panels)
    title = f"{PERIODS} periods of the drive\nabout the largest $|w|$" if has_room else None
    panels[-1].legend(handles=keys, loc="center" if has_room else "upper right", title=title, title_fontsize=6.5)
    return figure
