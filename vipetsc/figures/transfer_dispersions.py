"""Dispersion of whole runs side by side: contact laws in rows, amplitudes in columns."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.dispersion import bloch_branches
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.members import configuration, configuration_stem, law_name, transfer_members
from vipetsc.figures.study import Study
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import pass_bands

DECADES = 5
MOST_ROWS = 800  # of a spectrum that are kept in memory; a printed panel shows fewer


@dataclass(frozen=True)
class Panel:
    """The dispersion ``energy`` (wavenumber, frequency) of one member over its largest value."""

    case: Case
    wavenumber: np.ndarray
    frequency: np.ndarray
    energy: np.ndarray
    ibtet: float

    @classmethod
    def read(cls, folder: Path) -> Panel:
        """The member in ``folder``, its spectrum no finer than a page can show."""
        with RunFile(folder / "run.h5") as run, h5py.File(folder / "analysis.h5") as analysis:
            frequency = analysis["frequency"][...]
            kept = frequency <= 1.1 * pass_bands(run.model.chain.cell)[-1].high
            energy = style.pooled(analysis["dispersion"][:, kept], MOST_ROWS, MOST_ROWS)
            return cls(run.case, analysis["wavenumber"][...], frequency[kept], energy, float(analysis["ibtet"][()]))


def transfer_dispersions(study: Study) -> Iterator[Drawing]:
    """The paper's Fig. FourBandDisp for every reading and configuration: laws in rows, amplitudes in columns."""
    groups: dict[str, list[Path]] = {}
    for run, analysis in transfer_members(study):
        if "dispersion" in analysis:
            groups.setdefault(configuration_stem(run.case), []).append(run.path.parent)
    for stem, folders in groups.items():
        yield stem, partial(_table_of, folders)


def _table_of(folders: Iterable[Path]) -> Figure:
    return table_of_dispersions([Panel.read(folder) for folder in folders])


def table_of_dispersions(panels: list[Panel]) -> Figure:
    """One panel a member; colours run over ``DECADES`` below each panel's own largest value."""
    laws = sorted({p.case.contacts.law for p in panels}, reverse=True)
    amplitudes = sorted({p.case.drive.amplitude for p in panels})
    figure = style.new_figure(style.PAGE, 0.4 + 2.1 * len(laws))
    case = panels[0].case
    heading = f"{case.lattice.reading.capitalize()}, {configuration(case)}"
    figure.suptitle(heading, fontsize=8, x=0.01, ha="left")
    table = figure.subplots(len(laws), len(amplitudes), sharex=True, sharey=True, squeeze=False)
    norm = style.log_norm(1.0, DECADES)
    found = {(p.case.contacts.law, p.case.drive.amplitude): p for p in panels}
    for i, law in enumerate(laws):
        for j, amplitude in enumerate(amplitudes):
            axes = table[i, j]
            panel = found.get((law, amplitude))
            if panel is None:
                style.say(axes, "no such run")
                continue
            largest = panel.energy.max() or 1.0
            values = panel.energy.T / largest
            image = style.draw_map(axes, panel.wavenumber / np.pi, panel.frequency / 1e3, values, norm, "inferno")
            bloch_branches(axes, panel.case.unit_cell())
            axes.set(xlim=(0, panel.wavenumber[-1] / np.pi), ylim=(0, panel.frequency[-1] / 1e3))
            style.letter(axes, f"({'abcdef'[i]}.{j + 1}) {law_name(panel.case)}, {amplitude:.4g} N")
            axes.text(0.03, 0.41, f"IBTET {panel.ibtet:.2g}", color="white", fontsize=6.5, transform=axes.transAxes)
            if i == len(laws) - 1:
                axes.set_xlabel("Wavenumber κ (π rad/cell)")
        table[i, 0].set_ylabel("Frequency ω (krad/s)")
    figure.colorbar(image, ax=table, label="Energy per bin over its largest", pad=0.01, extend="min", aspect=35)
    return figure
