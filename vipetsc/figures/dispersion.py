"""Energy over wavenumber and frequency before and after the first site, with the Bloch branches over it."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.panels import (
    KAPPA,
    OMEGA,
    below_cutoff,
    colour_bar,
    dispersion_map,
    empty_figure,
    log_norm,
    panel_title,
    shade_bands,
)
from vipetsc.lattice import pass_bands

PANELS = {
    "dispersion_before": ("Before the first site", style.BLUE),
    "dispersion_after": ("After the first site", style.VERMILION),
    "dispersion": ("All cells", style.BLACK),
}


def dispersion(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """2-D spectra of the cells before and after the first site, and their sums over wavenumber."""
    measured = [name for name in PANELS if analysis is not None and name in analysis]
    if analysis is None or not measured:
        return empty_figure("Dispersion: needs the analysis of a run that recorded two cells or more")
    model = Case.of(run).model()
    cell = model.chain.cell
    spectra = below_cutoff(analysis, cell, [name for name in measured if name != "dispersion"] or measured)
    norm = log_norm(max(float(s.max()) for s in spectra.values()))

    figure = style.new_figure(style.PAGE if len(spectra) > 1 else 5.0, 3.2)
    widths = [1.0] * len(spectra) + [0.55]
    *maps, side = figure.subplots(1, len(spectra) + 1, sharey=True, gridspec_kw={"width_ratios": widths})
    for axes, letter, (name, spectrum) in zip(maps, "ab", spectra.items(), strict=False):
        image = dispersion_map(axes, spectrum, norm, cell)
        axes.set_xlabel(KAPPA)
        panel_title(axes, f"({letter}) {PANELS[str(name)][0]}")
    maps[0].set_ylabel(OMEGA)
    colour_bar(figure, image, [*maps, side], "Mean kinetic energy per bin (J)")
    shade_bands(side, ((band.low, band.high) for band in pass_bands(cell)))
    _sums(side, spectra, model.drive.frequency)
    panel_title(side, f"({'abc'[len(spectra)]}) Sum over κ")
    return figure


def _sums(axes: Axes, spectra: xr.Dataset, drive: float) -> None:
    """Energy against frequency, so that what reaches the upper bands can be read off; the drive (rad/s) dotted."""
    largest = 0.0
    for name, spectrum in spectra.items():
        total = spectrum.sum("wavenumber").values
        largest = max(largest, total.max())
        text, colour = PANELS[str(name)]
        label = text.split()[0].lower()
        axes.plot(np.maximum(total, 1e-300), spectrum["frequency"] / 1e3, color=colour, lw=0.7, label=label)
    axes.axhline(drive / 1e3, color=style.BLACK, lw=0.6, ls=":")
    largest = largest or 1.0
    axes.set(xscale="log", xlim=(largest * 1e-7, largest * 3), xlabel="Energy (J)")
    axes.annotate("drive", (1, drive / 1e3), (-2, 2), xycoords=("axes fraction", "data"), textcoords="offset points",
                  ha="right", va="bottom", fontsize=6.5)  # fmt: skip
    axes.legend(loc="lower right")
