"""A cell's bands; a lattice with its cell and bands (paper, Figs. 1 and 6); the reduced model (Fig. 10)."""

import numpy as np
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.lattice import draw_lattice, draw_mass, draw_spring, draw_unit_cell, draw_wall, with_prefix
from vipetsc.figures.panels import band_diagram, colours, panel_title, shade_bands
from vipetsc.figures.study import counted
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands

STRIP = 0.52  # height in inches of a lattice drawn as a strip of cells
SIDE = 0.5  # half the side of a mass of the reduced model


def lattice_page(case: Case, sites: tuple[int, ...]) -> Figure:
    """The cell, its dispersion with the drive marked, and the lattice with as many contact ``sites`` as listed."""
    figure = style.new_figure(style.PAGE, 2.9 + STRIP * len(sites))
    upper, lower = figure.subfigures(2, 1, height_ratios=(2.9, STRIP * len(sites)))
    left, right = upper.subplots(1, 2, gridspec_kw={"width_ratios": (1.55, 1)})
    draw_unit_cell(left, case.unit_cell())
    panel_title(left, f"(a) Unit cell, {case.lattice.reading} reading")
    band_diagram(right, case.unit_cell(), case.drive.frequency)
    panel_title(right, "(b) Bands; gaps shaded, drive dotted")
    strips = lower.subplots(len(sites), 1, squeeze=False)[:, 0]
    table = case.model_dump(by_alias=True, exclude_none=True, exclude={"contacts": {"clearance"}})
    for i, (axes, count) in enumerate(zip(strips, sites, strict=True)):
        table["contacts"]["sites"] = count
        model = Case.from_table(table).model()
        draw_lattice(axes, model.chain, model.drive_cell, brief=True)
        legend = "; cell above, clearance in mm below; driven at the arrow" if i == 0 else ""
        panel_title(axes, f"(c.{i + 1}) {counted(count, 'contact site')}{legend}")
    return figure


def reduced_model(masses: tuple[float, float], springs: tuple[float, float], clearance: float) -> Figure:
    """The 2-DoF model: host held by a wall, resonator on it by a spring and the contact; kg, N/m, m."""
    figure = style.new_figure(style.PAGE * 0.72, 1.7)
    axes = figure.subplots()
    draw_wall(axes, (-0.35, -0.8), 0.35, 1.9)
    axes.plot([0, 0], [-0.8, 1.1], color=style.BLACK, lw=1.0)
    host, resonator = 2.6, 6.6
    draw_spring(axes, [(0, 0), (host - SIDE, 0)], rf"$k_1$ = {with_prefix(springs[0], 'N/m')}")
    start, end = host + SIDE, resonator - SIDE
    draw_spring(axes, [(start, 0.26), (end, 0.26)], rf"$k_2$ = {with_prefix(springs[1], 'N/m')}")
    middle, gap = (start + end) / 2, 0.16
    for edge, stop in ((start, middle - gap), (end, middle + gap)):
        axes.plot([edge, stop], [-0.3, -0.3], color=style.VERMILION, lw=1.0)
        axes.plot([stop, stop], [-0.46, -0.14], color=style.VERMILION, lw=2.0)
    text = f"contact on both sides, Δ = {1e3 * clearance:.4g} mm"
    axes.text(middle, -0.56, text, ha="center", va="top", fontsize=6.5, color=style.VERMILION)
    for i, (x, mass, colour) in enumerate(zip((host, resonator), masses, (style.SKY, style.ORANGE), strict=True)):
        draw_mass(axes, (x, 0), SIDE, i, colour)
        axes.text(x, -SIDE - 0.06, with_prefix(1e3 * mass, "g"), ha="center", va="top", fontsize=6.5)
        arrow = {"arrowstyle": "-|>", "lw": 0.8, "color": style.BLUE, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", (x + 0.9, 0.85), (x, 0.85), arrowprops=arrow)
        axes.plot([x, x], [0.72, 0.98], color=style.BLUE, lw=0.8)
        axes.text(x + 0.95, 0.85, f"$u_{i + 1}$", va="center", fontsize=7, color=style.BLUE)
    axes.set(xlim=(-0.5, 8.0), ylim=(-0.95, 1.2), aspect="equal")
    axes.set_axis_off()
    return figure


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
