"""Phase portraits of the one contact cell in the lattice at rising amplitudes (paper, Figs. S4 and S5)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import centred_limits, panel_title, recorded_sites
from vipetsc.figures.phase import refined
from vipetsc.figures.study import (
    MeasuredRun,
    Study,
    configuration,
    configuration_stem,
    grouped,
    law_name,
    sites_of,
    transfer_members,
)
from vipetsc.figures.transfer_curves import TransferCurve, transfer_curves
from vipetsc.io.read import field_interval, field_time

PERIODS = 10  # of the drive that a portrait shows
RED = "#CC0000"


class ContactMotion(NamedTuple):
    """Displacement in m and velocity in m/s (t, 2) of host and resonator of the contact cell, and the transfer."""

    case: Case
    displacement: np.ndarray
    velocity: np.ndarray
    ibtet: float

    @classmethod
    def of(cls, member: MeasuredRun, periods: float = PERIODS) -> ContactMotion:
        """The motion over ``periods`` of the drive about the time of the largest relative displacement."""
        run, cell = member.run, member.model.chain.cell
        motion = run.sel(cell=run["sites/cell"].values[0]).isel(dof=[cell.host, cell.resonator])
        displacement, velocity = motion["displacement"].values, motion["velocity"].values
        middle = int(np.argmax(np.abs(displacement[:, 1] - displacement[:, 0])))
        half = round(periods * np.pi / member.model.drive.frequency / field_interval(run))
        shown = slice(max(middle - half, 0), middle + half + 1)
        u, v, _ = refined(displacement[shown], velocity[shown], field_time(run)[shown])
        return cls(member.case, u, v, float(member.analysis["ibtet"]))

    @classmethod
    def read(cls, folder: Path) -> ContactMotion:
        """The motion of the member in ``folder``; raises OSError or ValueError."""
        with MeasuredRun.open(folder) as member:
            return cls.of(member)


def phase_regimes(study: Study) -> Iterator[Drawing]:
    """Trajectories of one embedded contact cell, for every law and reading, beside the transfer curve."""
    members = ((m.case, m.folder) for m in transfer_members(study) if _is_recorded(m))
    curves = list(transfer_curves(study))
    for name, group in grouped(members, lambda pair: _settings(pair[0])).items():
        sites = sites_of(group[0][0])
        matching = [c for c in curves if _settings(c.case) == name and sites_of(c.case) == sites]
        yield name, partial(_page, [folder for _, folder in group], matching[0] if matching else None)


def _is_recorded(member: MeasuredRun) -> bool:
    """Whether the lattice has one contact site and the motion of its cell was recorded."""
    run = member.run
    return len(recorded_sites(run)) == run.sizes["site"] == 1 and {"displacement", "velocity"} <= run.keys()


def _settings(case: Case) -> str:
    return f"{case.contacts.law}-{configuration_stem(case)}"


def _page(folders: Sequence[Path], curve: TransferCurve | None) -> Figure:
    motions = sorted(map(ContactMotion.read, folders), key=lambda motion: motion.case.drive.amplitude)
    case = motions[0].case
    columns = -(-len(motions) // 2)
    heading = f"{law_name(case)}, {case.lattice.reading}, {configuration(case)}, cell {sites_of(case)[0]}"
    figure = style.new_figure(style.PAGE, 3.4, heading, left=True)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 0.62 * columns))
    _curve(left.subplots(), motions, curve)
    panels = right.subplots(2, columns, squeeze=False).ravel()
    for number, (axes, motion) in enumerate(zip(panels, motions, strict=False), 1):
        _trajectories(axes, motion, number)
    for axes in panels[len(motions) :]:
        axes.set_axis_off()
    keys = [Line2D([], [], color=c, label=n) for c, n in ((RED, "host"), (style.BLUE, "resonator"))]
    has_room = len(motions) < len(panels)
    title = f"{PERIODS} periods of the drive\nabout the largest $|w|$" if has_room else None
    panels[-1].legend(handles=keys, loc="center" if has_room else "upper right", title=title, title_fontsize=6.5)
    return figure


def _curve(axes: Axes, motions: Sequence[ContactMotion], curve: TransferCurve | None) -> None:
    if curve is not None:
        axes.plot(curve.amplitude, curve.ibtet, "-o", color=style.GREY, ms=2, lw=0.7)
    for number, motion in enumerate(motions, 1):
        point = motion.case.drive.amplitude, motion.ibtet
        axes.plot(*point, "o", color=RED, ms=4, zorder=3)
        axes.annotate(str(number), point, (4, 3), textcoords="offset points", ha="left", fontsize=7.5, color=RED)
    axes.set(xscale="log", yscale="log", xlabel="Amplitude of the drive (N)", ylabel="Inter-band transfer (1)")
    axes.margins(x=0.08, y=0.12)
    panel_title(axes, "Transfer to higher bands")


def _trajectories(axes: Axes, motion: ContactMotion, number: int) -> None:
    displacement = 1e3 * motion.displacement
    for j, colour in ((1, style.BLUE), (0, RED)):
        axes.plot(displacement[:, j], motion.velocity[:, j], color=colour, lw=0.5)
    centred_limits(axes, displacement, motion.velocity, 1.08)
    axes.tick_params(labelsize=6, pad=1.5)
    axes.set_xlabel("$u$ (mm)", fontsize=7)
    axes.set_ylabel(r"$\dot u$ (m/s)", fontsize=7, labelpad=0)
    axes.set_box_aspect(1)
    panel_title(axes, f"{number}: {motion.case.drive.amplitude:.4g} N")
