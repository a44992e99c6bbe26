"""The dispersion diagram of a unit cell: branches, gaps and group velocity."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.panels import band_diagram, colours, panel_title, shade_bands
from vipetsc.lattice import UnitCell, bloch, pass_bands
from vipetsc.lattice.bloch import gaps


def bands(cell: UnitCell, frequency: float | None = None) -> Figure:
    """Frequency against wavenumber and against group velocity; gaps shaded, a drive ``frequency`` (rad/s) marked."""
    point, passing = bloch(cell, np.linspace(0, np.pi, 361)), pass_bands(cell)
    figure = style.new_figure(style.PAGE * 0.72, 3.0)
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": (1.3, 1)})
    band_diagram(left, cell, frequency)
    for band, colour, speed, branch in zip(
        passing, colours(len(passing)), point.group_velocity.T, point.frequency.T, strict=True
    ):
        right.plot(speed, branch / 1e3, color=colour)
        left.annotate(f"{band.number}", (1.0, (band.low + band.high) / 2e3), (3, 0), textcoords="offset points",
                      ha="left", va="center", color=colour)  # fmt: skip
    shade_bands(right, gaps(passing))
    if frequency is not None:
        right.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    right.set(xlabel="Group velocity dω/dκ (cells/s)")
    right.axvline(0, color=style.GREY, lw=0.5)
    panel_title(left, "(a) Bands; gaps shaded")
    panel_title(right, "(b) Group velocity")
    return figure
