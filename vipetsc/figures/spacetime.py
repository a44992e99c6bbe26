"""Where the energy is: over cells and time, and over wavenumbers and time."""

from __future__ import annotations

import h5py
import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.io.run_file import RunFile

DECADES = 5


def spacetime(run: RunFile, analysis: h5py.File | None) -> Figure:
    """Kinetic energy of every cell over time with the sites marked, beside the wavenumber content."""
    if analysis is None or "time" not in analysis or len(analysis["time"]) < 2:
        return style.without_data("Kinetic energy: needs the analysis of a run with two samples or more")
    time, cells = analysis["time"][...], analysis["cell"][...]
    several = "wavenumber_content" in analysis
    figure = style.new_figure(style.PAGE if several else style.COLUMN, 2.5)
    panels = np.atleast_1d(figure.subplots(1, 1 + several))
    _energy_map(figure, panels[0], time, cells, analysis["kinetic_energy"][...])
    _mark_sites(panels[0], run, cells)
    if several:
        content, wavenumber = analysis["wavenumber_content"][...].T, analysis["wavenumber"][...]
        image = style.draw_map(
            panels[1], time, wavenumber / np.pi, content, style.log_norm(content.max(), 4), "viridis"
        )
        panels[1].set(xlabel="Time (s)", ylabel="Wavenumber (π rad/cell)", ylim=(0, wavenumber[-1] / np.pi))
        style.letter(panels[1], "(b) Wavenumber content")
        figure.colorbar(image, ax=panels[1], label="Kinetic energy per bin (J)", pad=0.02, extend="min")
        style.letter(panels[0], "(a) Kinetic energy")
    return figure


def _energy_map(figure: Figure, axes, time: np.ndarray, cells: np.ndarray, energy: np.ndarray) -> None:
    if len(cells) == 1:
        axes.plot(time, energy[:, 0], color=style.BLUE, lw=0.6)
        axes.set(xlabel="Time (s)", ylabel=f"Kinetic energy of cell {cells[0]} (J)", xlim=time[[0, -1]])
        return
    image = style.draw_map(axes, time, cells, energy.T, style.log_norm(energy.max(), DECADES), "inferno")
    axes.set(xlabel="Time (s)", ylabel="Cell", ylim=(cells[0] - 0.5, cells[-1] + 0.5))
    figure.colorbar(image, ax=axes, label="Kinetic energy of a cell (J)", pad=0.02, extend="min")


def _mark_sites(axes, run: RunFile, cells: np.ndarray) -> None:
    """Dotted lines at the contact sites and triangles that point at them from the left edge."""
    if len(cells) == 1:
        return
    sites = run.site_cells[(run.site_cells >= cells[0]) & (run.site_cells <= cells[-1])]
    for site in sites:
        axes.axhline(site, color="white", lw=0.5, ls=(0, (1, 2)), alpha=0.8)
    axes.plot(
        np.full(len(sites), 0.012),
        sites,
        ">",
        color=style.SKY,
        mec="white",
        mew=0.3,
        ms=3.5,
        transform=axes.get_yaxis_transform(),
        clip_on=False,
        label="contact sites",
    )
    if len(sites):
        axes.legend(loc="upper left", labelcolor="white", handletextpad=0.3)
