"""The dispersion diagram of a unit cell: branches, gaps and group velocity."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.lattice import UnitCell, bloch, pass_bands
from vipetsc.lattice.bloch import gaps

BRANCHES = (style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY)


def bands(cell: UnitCell, frequency: float | None = None) -> Figure:
    """Frequency against wavenumber and against group velocity; gaps shaded, a drive ``frequency`` marked."""
    kappa = np.linspace(0, np.pi, 361)
    point = bloch(cell, kappa)
    found = pass_bands(cell)
    figure = style.new_figure(style.PAGE * 0.72, 3.0)
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": (1.3, 1)})
    for band in found:
        colour = BRANCHES[(band.number - 1) % len(BRANCHES)]
        left.plot(kappa / np.pi, point.frequency[:, band.number - 1] / 1e3, color=colour)
        right.plot(point.group_velocity[:, band.number - 1], point.frequency[:, band.number - 1] / 1e3, color=colour)
    top = 1.08 * found[-1].high / 1e3
    for axes in (left, right):
        for low, high in gaps(found):
            axes.axhspan(low / 1e3, high / 1e3, color=style.PALE, alpha=0.7, lw=0)
        if frequency is not None:
            axes.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    for band in found:
        left.annotate(f"{band.number}", (1.0, (band.low + band.high) / 2e3), (3, 0), textcoords="offset points",
                      ha="left", va="center", color=BRANCHES[(band.number - 1) % len(BRANCHES)])  # fmt: skip
    left.set(xlim=(0, 1), ylim=(0, top), xlabel="Wavenumber κ (π rad/cell)", ylabel="Angular frequency ω (krad/s)")
    right.set(xlabel="Group velocity dω/dκ (cells/s)")
    right.axvline(0, color=style.GREY, lw=0.5)
    style.letter(left, "(a) Bands; gaps shaded")
    style.letter(right, "(b) Group velocity")
    return figure
