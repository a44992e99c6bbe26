"""Energy over wavenumber and frequency before and after the first site, with the Bloch branches over it."""

from __future__ import annotations

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import bloch, pass_bands
from vipetsc.lattice.cell import UnitCell

DECADES = 5
PANELS = {
    "dispersion_before": "Before the first site",
    "dispersion_after": "After the first site",
    "dispersion": "All cells",
}


def dispersion(run: RunFile, analysis: h5py.File | None) -> Figure:
    """2-D spectra of the cells before and after the first site, and their sums over wavenumber."""
    found = [name for name in PANELS if analysis is not None and name in analysis]
    if not found:
        return style.without_data("Dispersion: needs the analysis of a run that recorded two cells or more")
    shown = [name for name in found if name != "dispersion"] or found
    cell = run.model.chain.cell
    frequency, wavenumber = analysis["frequency"][...], analysis["wavenumber"][...]
    top = min(1.1 * pass_bands(cell)[-1].high, frequency[-1])
    kept = frequency <= top
    spectra = {name: analysis[name][...][:, kept] for name in shown}
    norm = style.log_norm(max(s.max() for s in spectra.values()), DECADES)

    figure = style.new_figure(style.PAGE if len(shown) > 1 else 5.0, 3.2)
    widths = [1.0] * len(shown) + [0.55]
    *maps, side = figure.subplots(1, len(shown) + 1, sharey=True, gridspec_kw={"width_ratios": widths})
    for i, (axes, (name, spectrum)) in enumerate(zip(maps, spectra.items(), strict=True)):
        image = style.draw_map(axes, wavenumber / np.pi, frequency[kept] / 1e3, spectrum.T, norm, "inferno")
        bloch_branches(axes, cell)
        axes.set(xlabel="Wavenumber κ (π rad/cell)", xlim=(0, wavenumber[-1] / np.pi), ylim=(0, top / 1e3))
        style.letter(axes, f"({'abc'[i]}) {PANELS[name]}")
    maps[0].set_ylabel("Angular frequency ω (krad/s)")
    figure.colorbar(
        image, ax=[*maps, side], label="Mean kinetic energy per bin (J)", location="right", pad=0.01, extend="min"
    )
    _sums(side, cell, frequency[kept], spectra, run.model.drive.frequency)
    style.letter(side, f"({'abc'[len(shown)]}) Sum over κ")
    return figure


def bloch_branches(axes: Axes, cell: UnitCell) -> None:
    """The Bloch branches of ``cell`` over wavenumber (pi rad/cell) and frequency (krad/s), dashed white."""
    kappa = np.linspace(0, np.pi, 181)
    axes.plot(kappa / np.pi, bloch(cell, kappa).frequency / 1e3, color="white", lw=0.5, ls=(0, (4, 3)), alpha=0.75)


def _sums(axes: Axes, cell: UnitCell, frequency: np.ndarray, spectra: dict, driven: float) -> None:
    """Energy against frequency, pass bands shaded, so that what reaches the upper bands can be read off."""
    for band in pass_bands(cell):
        axes.axhspan(band.low / 1e3, band.high / 1e3, color=style.PALE, alpha=0.6, lw=0)
    colours = {"dispersion_before": style.BLUE, "dispersion_after": style.VERMILION}
    largest = 0.0
    for name, spectrum in spectra.items():
        total = spectrum.sum(axis=0)
        largest = max(largest, total.max())
        label = PANELS[name].split()[0].lower()
        axes.plot(np.maximum(total, 1e-300), frequency / 1e3, color=colours.get(name, style.BLACK), lw=0.7, label=label)
    axes.axhline(driven / 1e3, color=style.BLACK, lw=0.6, ls=":")
    largest = largest or 1.0
    axes.set(xscale="log", xlim=(largest * 1e-7, largest * 3), xlabel="Energy (J)")
    axes.annotate("drive", (1, driven / 1e3), (-2, 2), xycoords=("axes fraction", "data"),
                  textcoords="offset points", ha="right", va="bottom", fontsize=6.5)  # fmt: skip
    axes.legend(loc="lower right")
