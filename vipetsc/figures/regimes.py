"""Phase portraits of the one contact cell in the lattice at rising amplitudes, beside its transfer curve."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.members import configuration, configuration_stem, law_name, transfer_members
from vipetsc.figures.phase import refined
from vipetsc.figures.study import Study
from vipetsc.figures.transfer_curves import TransferCurve, transfer_curves
from vipetsc.io.run_file import RunFile

PERIODS = 10  # of the drive that a portrait shows
RED = "#CC0000"


@dataclass(frozen=True)
class Portrait:
    """Displacement in m and velocity in m/s (t, 2) of host and resonator of the contact cell, and the transfer."""

    case: Case
    displacement: np.ndarray
    velocity: np.ndarray
    ibtet: float
    clearance: float

    @classmethod
    def of(cls, run: RunFile, ibtet: float, periods: float = PERIODS) -> Portrait:
        """The motion over ``periods`` of the drive about the time of the largest relative displacement."""
        cell = run.model.chain.cell
        at, pair = run.nearest(run.site_cells[0]), [cell.host, cell.resonator]
        displacement, velocity = run.displacement[:, at][:, pair], run.velocity[:, at][:, pair]
        middle = int(np.argmax(np.abs(displacement[:, 1] - displacement[:, 0])))
        half = round(periods * np.pi / run.model.drive.frequency / run.field_interval)
        shown = slice(max(middle - half, 0), middle + half + 1)
        u, v, _ = refined(displacement[shown], velocity[shown], run.field_time[shown])
        return cls(run.case, u, v, ibtet, float(run.clearances[0]))

    @classmethod
    def read(cls, folder: Path) -> Portrait:
        """The motion of the member in ``folder``."""
        with RunFile(folder / "run.h5") as run, h5py.File(folder / "analysis.h5") as analysis:
            return cls.of(run, float(analysis["ibtet"][()]))


def phase_regimes(study: Study) -> Iterator[Drawing]:
    """The supplement's phase trajectories of one embedded contact cell, for every law and reading."""
    groups: dict[str, tuple[Case, list[Path]]] = {}
    for run, _ in transfer_members(study):
        recorded = {"displacement", "velocity"} <= run.file.keys() and run.site_cells[0] in run.cells
        if len(run.site_cells) == 1 and recorded:
            name = f"{run.case.contacts.law}-{configuration_stem(run.case)}"
            groups.setdefault(name, (run.case, []))[1].append(run.path.parent)
    curves = list(transfer_curves(study))
    for name, (case, folders) in groups.items():
        alike = [c for c in curves if _settings(c.case) == _settings(case)]
        yield name, partial(_page_of, folders, alike[0] if alike else None)


def _page_of(folders: Iterable[Path], curve: TransferCurve | None) -> Figure:
    return _page(sorted(map(Portrait.read, folders), key=lambda p: p.case.drive.amplitude), curve)


def _settings(case: Case) -> tuple:
    return case.contacts.law, configuration_stem(case), tuple(case.contacts.sites)


def _page(portraits: Sequence[Portrait], curve: TransferCurve | None) -> Figure:
    case = portraits[0].case
    columns = -(-len(portraits) // 2)
    figure = style.new_figure(style.PAGE, 3.4)
    heading = f"{law_name(case)}, {case.lattice.reading}, {configuration(case)}, cell {case.contacts.sites[0]}"
    figure.suptitle(heading, fontsize=8, x=0.01, ha="left")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 0.62 * columns))
    _curve(left.subplots(), portraits, curve)
    panels = right.subplots(2, columns, squeeze=False).ravel()
    for number, (axes, portrait) in enumerate(zip(panels, portraits, strict=False), 1):
        _portrait(axes, portrait, number)
    for axes in panels[len(portraits) :]:
        axes.set_axis_off()
    keys = [Line2D([], [], color=c, label=n) for c, n in ((RED, "host"), (style.BLUE, "resonator"))]
    spare = len(portraits) < len(panels)
    title = f"{PERIODS} periods of the drive\nabout the largest $|w|$" if spare else None
    panels[-1].legend(handles=keys, loc="center" if spare else "upper right", title=title, title_fontsize=6.5)
    return figure


def _curve(axes: Axes, portraits: Sequence[Portrait], curve: TransferCurve | None) -> None:
    if curve is not None:
        axes.plot(curve.amplitude, curve.ibtet, "-o", color=style.GREY, ms=2, lw=0.7)
    for number, portrait in enumerate(portraits, 1):
        at = portrait.case.drive.amplitude, portrait.ibtet
        axes.plot(*at, "o", color=RED, ms=4, zorder=3)
        axes.annotate(str(number), at, (4, 3), textcoords="offset points", ha="left", fontsize=7.5, color=RED)
    axes.set(xscale="log", yscale="log", xlabel="Amplitude of the drive (N)", ylabel="Inter-band transfer (1)")
    axes.margins(x=0.08, y=0.12)
    style.letter(axes, "Transfer to higher bands")


def _portrait(axes: Axes, portrait: Portrait, number: int) -> None:
    for j, colour in ((1, style.BLUE), (0, RED)):
        axes.plot(1e3 * portrait.displacement[:, j], portrait.velocity[:, j], color=colour, lw=0.5)
    for values, place in ((1e3 * portrait.displacement, axes.set_xlim), (portrait.velocity, axes.set_ylim)):
        reach = 1.08 * np.abs(values).max() or 1.0
        place(-reach, reach)
    axes.tick_params(labelsize=6, pad=1.5)
    axes.set_xlabel("$u$ (mm)", fontsize=7)
    axes.set_ylabel(r"$\dot u$ (m/s)", fontsize=7, labelpad=0)
    axes.set_box_aspect(1)
    style.letter(axes, f"{number}: {portrait.case.drive.amplitude:.4g} N")
