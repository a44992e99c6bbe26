"""Where the energy is: over cells and time, and over wavenumbers and time."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.panels import (
    KAPPA,
    colour_bar,
    draw_map,
    empty_figure,
    log_norm,
    mark_sites,
    panel_title,
    recorded_sites,
    space_time_map,
)


def spacetime(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Kinetic energy (J) of every cell over time with the sites marked, beside the wavenumber content."""
    if analysis is None or analysis.sizes.get("time", 0) < 2:
        return empty_figure("Kinetic energy: needs the analysis of a run with two samples or more")
    energy, cells, time = analysis["kinetic_energy"], analysis["cell"].values, analysis["time"].values
    has_content = "wavenumber_content" in analysis
    figure = style.new_figure(style.PAGE if has_content else style.COLUMN, 2.5)
    left, *right = np.atleast_1d(figure.subplots(1, 1 + has_content))
    if len(cells) == 1:
        left.plot(time, energy[:, 0], color=style.BLUE, lw=0.6)
        left.set(xlabel="Time (s)", ylabel=f"Kinetic energy of cell {cells[0]} (J)", xlim=time[[0, -1]])
    else:
        image = space_time_map(left, energy, log_norm(float(energy.max())))
        colour_bar(figure, image, left, "Kinetic energy of a cell (J)", 0.02)
        mark_sites(left, run)
        if len(recorded_sites(run)):
            left.legend(loc="upper left", labelcolor="white", handletextpad=0.3)
    for axes in right:
        content, kappa = analysis["wavenumber_content"].values.T, analysis["wavenumber"].values / np.pi
        image = draw_map(axes, time, kappa, content, log_norm(content.max(), 4), "viridis")
        axes.set(xlabel="Time (s)", ylabel=KAPPA, ylim=(0, kappa[-1]))
        panel_title(left, "(a) Kinetic energy")
        panel_title(axes, "(b) Wavenumber content")
        colour_bar(figure, image, axes, "Kinetic energy per bin (J)", 0.02)
    return figure
