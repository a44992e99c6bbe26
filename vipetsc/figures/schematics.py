"""The paper's schematics: a lattice with its cell and bands, and the reduced model of its contact cell."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.bands import BRANCHES
from vipetsc.figures.lattice import draw_lattice, draw_spring, draw_unit_cell, with_prefix
from vipetsc.lattice import bloch, pass_bands
from vipetsc.lattice.bloch import gaps

STRIP = 0.52  # height in inches of a lattice drawn as a strip of cells
SIDE = 0.5  # half the side of a mass of the reduced model


def lattice_page(case: Case, sites: tuple[int, ...]) -> Figure:
    """The cell, its dispersion with the drive marked, and the lattice with as many contact ``sites`` as listed."""
    figure = style.new_figure(style.PAGE, 2.9 + STRIP * len(sites))
    upper, lower = figure.subfigures(2, 1, height_ratios=(2.9, STRIP * len(sites)))
    left, right = upper.subplots(1, 2, gridspec_kw={"width_ratios": (1.55, 1)})
    draw_unit_cell(left, case.unit_cell())
    style.letter(left, f"(a) Unit cell, {case.lattice.reading} reading")
    _bands(right, case)
    style.letter(right, "(b) Bands; gaps shaded, drive dotted")
    strips = lower.subplots(len(sites), 1, squeeze=False)[:, 0]
    table = case.model_dump(by_alias=True, exclude_none=True, exclude={"contacts": {"clearance"}})
    for i, (axes, count) in enumerate(zip(strips, sites, strict=True)):
        table["contacts"]["sites"] = count
        model = Case.from_table(table).model()
        draw_lattice(axes, model.chain, model.drive_cell, brief=True)
        words = "1 contact site" if count == 1 else f"{count} contact sites"
        legend = "; cell above, clearance in mm below; driven at the arrow" if i == 0 else ""
        style.letter(axes, f"(c.{i + 1}) {words}{legend}")
    return figure


def _bands(axes: Axes, case: Case) -> None:
    cell = case.unit_cell()
    kappa = np.linspace(0, np.pi, 361)
    frequency = bloch(cell, kappa).frequency
    found = pass_bands(cell)
    for band in found:
        colour = BRANCHES[(band.number - 1) % len(BRANCHES)]
        axes.plot(kappa / np.pi, frequency[:, band.number - 1] / 1e3, color=colour)
    for low, high in gaps(found):
        axes.axhspan(low / 1e3, high / 1e3, color=style.PALE, alpha=0.7, lw=0)
    axes.axhline(case.drive.frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), ylim=(0, 1.08 * found[-1].high / 1e3))
    axes.set(xlabel="Wavenumber κ (π rad/cell)", ylabel="Angular frequency ω (krad/s)")


def reduced_model(masses: tuple[float, float], springs: tuple[float, float], clearance: float) -> Figure:
    """The 2-DoF model: host held by a wall, resonator on it by a spring and the contact; kg, N/m, m."""
    figure = style.new_figure(style.PAGE * 0.72, 1.7)
    axes = figure.subplots()
    axes.add_patch(Rectangle((-0.35, -0.8), 0.35, 1.9, fc="white", ec=style.GREY, hatch="//////", lw=0))
    axes.plot([0, 0], [-0.8, 1.1], color=style.BLACK, lw=1.0)
    places = (2.6, 6.6)
    draw_spring(axes, (0, 0), (places[0] - SIDE, 0), rf"$k_1$ = {with_prefix(springs[0], 'N/m')}")
    start, end = places[0] + SIDE, places[1] - SIDE
    draw_spring(axes, (start, 0.26), (end, 0.26), rf"$k_2$ = {with_prefix(springs[1], 'N/m')}")
    middle, gap = (start + end) / 2, 0.16
    for side, edge in ((-1, start), (1, end)):
        stop = middle + side * gap
        axes.plot([edge, stop], [-0.3, -0.3], color=style.VERMILION, lw=1.0)
        axes.plot([stop, stop], [-0.46, -0.14], color=style.VERMILION, lw=2.0)
    words = f"contact on both sides, Δ = {1e3 * clearance:.4g} mm"
    axes.text(middle, -0.56, words, ha="center", va="top", fontsize=6.5, color=style.VERMILION)
    for i, (x, mass, colour) in enumerate(zip(places, masses, (style.SKY, style.ORANGE), strict=True)):
        look = {"boxstyle": "round,pad=0,rounding_size=0.08", "fc": colour, "ec": style.BLACK, "lw": 0.7, "zorder": 3}
        axes.add_patch(FancyBboxPatch((x - SIDE, -SIDE), 2 * SIDE, 2 * SIDE, **look))
        axes.text(x, 0, f"$m_{i + 1}$", ha="center", va="center", zorder=4)
        axes.text(x, -SIDE - 0.06, with_prefix(1e3 * mass, "g"), ha="center", va="top", fontsize=6.5)
        arrow = {"arrowstyle": "-|>", "lw": 0.8, "color": style.BLUE, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (x + 0.9, 0.85), (x, 0.85), arrowprops=arrow)
        axes.plot([x, x], [0.72, 0.98], color=style.BLUE, lw=0.8)
        axes.text(x + 0.95, 0.85, f"$u_{i + 1}$", va="center", fontsize=7, color=style.BLUE)
    axes.set(xlim=(-0.5, 8.0), ylim=(-0.95, 1.2), aspect="equal")
    axes.set_axis_off()
    return figure
