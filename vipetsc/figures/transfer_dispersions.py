"""Dispersion of whole runs side by side: contact laws in rows, amplitudes in columns (paper, Fig. 8)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import xarray as xr
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import (
    KAPPA,
    annotate_empty,
    below_cutoff,
    colour_bar,
    dispersion_map,
    log_norm,
    panel_title,
)
from vipetsc.figures.study import (
    MeasuredRun,
    Study,
    configuration_heading,
    configuration_stem,
    grouped,
    law_name,
    transfer_members,
)


class Panel(NamedTuple):
    """The ``dispersion`` (wavenumber, frequency) of one member, and its transfer."""

    case: Case
    dispersion: xr.DataArray
    ibtet: float

    @classmethod
    def read(cls, folder: Path) -> Panel:
        """The member in ``folder``; raises OSError or ValueError."""
        with MeasuredRun.open(folder) as member:
            spectra = below_cutoff(member.analysis, member.model.chain.cell, ["dispersion"])
            return cls(member.case, spectra["dispersion"], float(member.analysis["ibtet"]))


def transfer_dispersions(study: Study) -> Iterator[Drawing]:
    """Every reading and configuration: laws in rows, amplitudes in columns."""
    members = ((m.case, m.folder) for m in transfer_members(study) if "dispersion" in m.analysis)
    for name, group in grouped(members, lambda pair: configuration_stem(pair[0])).items():
        yield name, partial(_table, [folder for _, folder in group])


def _table(folders: Sequence[Path]) -> Figure:
    """One panel a member; colours run over five decades below each panel's own largest value."""
    panels = {(p.case.contacts.law, p.case.drive.amplitude): p for p in map(Panel.read, folders)}
    laws = sorted({law for law, _ in panels}, reverse=True)
    amplitudes = sorted({amplitude for _, amplitude in panels})
    heading = configuration_heading(next(iter(panels.values())).case)
    figure = style.new_figure(style.PAGE, 0.4 + 2.1 * len(laws), heading, left=True)
    grid = figure.subplots(len(laws), len(amplitudes), sharex=True, sharey=True, squeeze=False)
    for i, law in enumerate(laws):
        for j, amplitude in enumerate(amplitudes):
            axes, panel = grid[i, j], panels.get((law, amplitude))
            if panel is None:
                annotate_empty(axes, "no such run")
                continue
            energy = panel.dispersion / (float(panel.dispersion.max()) or 1.0)
            image = dispersion_map(axes, energy, log_norm(1.0), panel.case.unit_cell())
            panel_title(axes, f"({'abcdef'[i]}.{j + 1}) {law_name(panel.case)}, {amplitude:.4g} N")
            axes.text(0.03, 0.41, f"IBTET {panel.ibtet:.2g}", color="white", fontsize=6.5, transform=axes.transAxes)
            if i == len(laws) - 1:
                axes.set_xlabel(KAPPA)
        grid[i, 0].set_ylabel("Frequency ω (krad/s)")
    colour_bar(figure, image, grid.flat, "Energy per bin over its largest", aspect=35)
    return figure
