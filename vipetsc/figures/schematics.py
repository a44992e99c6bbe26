"""A unit cell as masses and springs, a lattice as a strip with its sites (paper, Figs. 1, 6); the reduced model."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path

from vipetsc.case import Case
from vipetsc.case.contacts import Gaps, describe_stops
from vipetsc.figures import style
from vipetsc.figures.panels import band_diagram, note
from vipetsc.figures.style import with_prefix
from vipetsc.figures.sweep_members import counted
from vipetsc.lattice import Chain, Spring, UnitCell

PITCH = 2.0  # distance between neighbouring masses of the drawing
HALF = 0.34  # half the side of a mass
WIDE, TALL = 1.0, 0.62  # half the width and height of a host that holds its resonator
GAP = 0.17  # clearance as drawn
SIDE = 0.5  # half the side of a mass of the reduced model
STRIP = 0.52  # height in inches of a lattice drawn as a strip of cells
LEGEND = "cell above, clearance in mm below; driven at the arrow"
ROD = {"color": style.BLACK, "lw": 0.7}

Point = tuple[float, float]


def unit_cell(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """The unit cell of the run's lattice and, below it, the lattice with ends, drive and contact sites."""
    model = Case.of(run).model()
    figure = style.new_figure(style.PAGE, 2.7)
    upper, lower = figure.subplots(2, 1, height_ratios=(2.1, 1))
    draw_unit_cell(upper, model.chain.cell)
    draw_lattice(lower, model.chain, model.drive_cell, model.gaps)
    differing = f" of the case, from which {counted(n, 'cell')} differ" if (n := int(model.chain.differs.sum())) else ""
    upper.set_title(f"(a) Unit cell{differing}")
    legend = LEGEND if model.drive.amplitude else LEGEND.replace("driven", "begins")
    lower.set_title(f"(b) Lattice of {model.chain.cells} cells, {model.chain.ends} ends; sites: {legend}")
    return figure


def lattice_page(case: Case, sites: tuple[int, ...]) -> Figure:
    """The cell, its dispersion with the drive marked, and the lattice with as many contact ``sites`` as listed."""
    figure = style.new_figure(style.PAGE, 2.9 + STRIP * len(sites))
    upper, lower = figure.subfigures(2, 1, height_ratios=(2.9, STRIP * len(sites)))
    left, right = upper.subplots(1, 2, width_ratios=(1.55, 1))
    draw_unit_cell(left, case.lattice.unit_cell())
    left.set_title(f"(a) Unit cell, {case.lattice.reading} reading")
    band_diagram(right, case.lattice.unit_cell(), case.drive.frequency)
    right.set_title("(b) Bands; gaps shaded, drive dotted")
    for i, (axes, count) in enumerate(zip(lower.subplots(len(sites), 1, squeeze=False).flat, sites, strict=True)):
        model = case.varied(contacts={"sites": count, "clearance": None}).model()
        draw_lattice(axes, model.chain, model.drive_cell)
        axes.set_title(f"(c.{i + 1}) {counted(count, 'contact site')}{f'; {LEGEND}' if i == 0 else ''}")
    return figure


def reduced_model(masses: tuple[float, float], springs: tuple[float, float], clearance: float) -> Figure:
    """The 2-DoF model: host held by a wall, resonator on it by a spring and the contact; kg, N/m, m."""
    figure = style.new_figure(style.PAGE * 0.72, 1.7)
    axes = figure.subplots()
    _wall(axes, (-0.35, -0.8), 0.35, 1.9)
    axes.plot([0, 0], [-0.8, 1.1], color=style.BLACK, lw=1.0)
    host, resonator = 2.6, 6.6
    start, end = host + SIDE, resonator - SIDE
    _spring(axes, [(0, 0), (host - SIDE, 0)], rf"$k_1$ = {with_prefix(springs[0], 'N/m')}")
    _spring(axes, [(start, 0.26), (end, 0.26)], rf"$k_2$ = {with_prefix(springs[1], 'N/m')}")
    middle, gap = (start + end) / 2, 0.16
    for edge, stop in ((start, middle - gap), (end, middle + gap)):
        axes.plot([edge, stop], [-0.3, -0.3], color=style.VERMILION, lw=1.0)
        axes.plot([stop, stop], [-0.46, -0.14], color=style.VERMILION, lw=2.0)
    below = {"ha": "center", "va": "top"}
    axes.text(middle, -0.56, f"contact on both sides, Δ = {1e3 * clearance:.4g} mm", color=style.VERMILION, **below)
    for i, (x, mass, colour) in enumerate(zip((host, resonator), masses, (style.SKY, style.ORANGE), strict=True)):
        _mass(axes, (x, 0), SIDE, i, colour)
        axes.text(x, -SIDE - 0.06, with_prefix(1e3 * mass, "g"), **below)
        arrow = {"arrowstyle": "<|-", "lw": 0.8, "color": style.BLUE, "shrinkA": 0, "shrinkB": 0}
        axes.annotate(f"$u_{i + 1}$", (x, 0.85), (x + 0.95, 0.85), va="center", color=style.BLUE, arrowprops=arrow)
    axes.set(xlim=(-0.5, 8.0), ylim=(-0.95, 1.2), aspect="equal")
    axes.set_axis_off()
    return figure


class _Layout(NamedTuple):
    """Where masses stand and half their widths; the cell's borders; whether the resonator sits inside its host."""

    centre: dict[int, Point]
    half: dict[int, float]
    left: float
    right: float
    nested: bool

    def corners(self, a: tuple[float, float, float], b: tuple[float, float, float], level: float) -> list[Point]:
        """The way of a spring between two ends, at the height ``level`` where masses stand between them.

        An end is x and y of a mass and half its width, which is 0 for the cell's border.
        """
        (xa, ya, half_a), (xb, yb, half_b) = sorted((a, b))
        if abs(xa - xb) < 0.1:  # b stands above
            return [(xb, yb - (TALL if half_b == WIDE else HALF)), (xa, ya + HALF)]
        if abs(ya - yb) >= 0.1:
            short = 1.3 * HALF * np.array([xb - xa, yb - ya]) / np.hypot(xb - xa, yb - ya)
            return [(xa + short[0], ya + short[1]), (xb - short[0], yb - short[1])]
        if any(xa < x < xb and abs(y - ya) < 0.1 for x, y in self.centre.values()):
            # Above the masses on the line, below those that hang from it.
            edge, round_them = (ya + HALF, level) if ya == 0 else (ya - HALF, ya - 2.4 * HALF)
            return [(xa, edge)] * (half_a > 0) + [(xa, round_them), (xb, round_them)] + [(xb, edge)] * (half_b > 0)
        return [(xa + half_a, ya), (xb - half_b, yb)]


def draw_unit_cell(axes: Axes, cell: UnitCell) -> None:
    """Masses, springs and the contact pair of ``cell``; a resonator held by its host alone sits inside it."""
    layout = _layout(cell)
    nested_pair = {cell.host, cell.resonator} if layout.nested else set()
    level, highest = TALL + 0.6, TALL
    for spring in (s for s in cell.springs if s.next_cell or {s.start, s.end} != nested_pair):
        start, end = ((*layout.centre[i], layout.half[i]) for i in (spring.start, spring.end))
        text = with_prefix(spring.stiffness, "N/m")
        if spring.next_cell:
            # One zigzag up to the right border, and the end of that of the cell before.
            leaving = layout.corners(start, (layout.right, start[1], 0), level)
            arriving = layout.corners((layout.left, end[1], 0), end, level)
            _spring(axes, leaving, text)
            _spring(axes, arriving, "", turns=0)
            for (x, y), side in ((leaving[-1], 1), (arriving[0], -1)):
                axes.plot([x, x + 0.4 * side], [y, y], ls=(0, (1, 1.5)), zorder=2, **ROD)
            goes_round = len(leaving) > 2 or len(arriving) > 2
        else:
            corners = layout.corners(start, end, level)
            _spring(axes, corners, text)
            goes_round = len(corners) > 2
        highest, level = max(highest, level * goes_round), level + 0.55 * goes_round
    for i, centre in layout.centre.items():
        if i not in nested_pair:
            colour = {cell.host: style.SKY, cell.resonator: style.ORANGE}.get(i, style.PALE)
            _mass(axes, centre, HALF, i, colour)
            # Beside the mass's lower left corner, clear of what hangs below it and of the spring on its left.
            corner = centre[0] - HALF - 0.05, centre[1] - HALF
            axes.text(*corner, with_prefix(1e3 * cell.masses[i], "g"), ha="right", va="center", zorder=4)
    host, resonator = layout.centre[cell.host], layout.centre[cell.resonator]
    if layout.nested:
        _host_with_resonator(axes, host, cell)
    elif cell.host != cell.resonator:
        # A bowed double arrow between the pair, whose resonator other masses hold too.
        arrow = {"arrowstyle": "<->", "color": style.VERMILION, "lw": 0.9, "ls": (0, (3, 1.5)), "shrinkA": 9,
                 "shrinkB": 9, "connectionstyle": "arc3,rad=0.45"}  # fmt: skip
        axes.annotate("", resonator, host, zorder=2, arrowprops=arrow)
        middle = np.mean([host, resonator], axis=0)
        note(axes, "contact, Δ", middle, (-16, 0), ha="right", va="center", color=style.VERMILION)
    low, high = min(y for _, y in layout.centre.values()) - TALL - 0.55, highest + 0.5
    axes.vlines([layout.left, layout.right], low + 0.15, high - 0.1, color=style.GREY, lw=0.6, ls=style.DASHED)
    axes.text(layout.left + 0.07, low + 0.1, "one cell", color=style.GREY, va="bottom")
    axes.set(xlim=(layout.left - 0.5, layout.right + 0.5), ylim=(low, high), aspect="equal")
    axes.set_axis_off()


def _layout(cell: UnitCell) -> _Layout:
    """The shortest way through the cell on one line; the others as far along by number of springs, below it."""
    pairs = [({s.start, s.end}, s.next_cell) for s in cell.springs if cell.resonator in (s.start, s.end)]
    nested = bool(pairs) and all(pair == {cell.host, cell.resonator} and not out for pair, out in pairs)
    joined = np.zeros((cell.dofs, cell.dofs), bool)
    for spring in cell.springs:
        joined[spring.start, spring.end] |= not spring.next_cell
    through = next((s for s in cell.springs if s.next_cell), Spring(cell.dofs - 1, 0, 1.0, next_cell=True))
    ends = [through.end, through.start]
    passed, ahead = shortest_path(csr_array(joined), directed=False, unweighted=True, indices=ends)
    # What no spring inside the cell holds stands at its end.
    depth = np.where(np.isfinite(passed), passed, np.max(passed, where=np.isfinite(passed), initial=0) + 1)
    extra = (WIDE - HALF) * nested
    centre: dict[int, Point] = {}
    for i in range(cell.dofs):
        x = PITCH * depth[i] + extra * (1 + np.sign(depth[i] - depth[cell.host]))
        y = 0.0 if passed[i] + ahead[i] == passed[through.start] else -0.75 * PITCH
        while (x, y) in centre.values():
            y -= 0.75 * PITCH
        if not (nested and i == cell.resonator):
            centre[i] = (x, y)
    if nested:
        centre[cell.resonator] = centre[cell.host]
    half = {i: WIDE if nested and i == cell.host else HALF for i in centre}
    left = min(x - half[i] for i, (x, _) in centre.items()) - 0.9
    right = max(x + half[i] for i, (x, _) in centre.items()) + 1.5
    return _Layout(centre, half, left, right, nested)


def _mass(axes: Axes, centre: Point, half: float, index: int, colour: str) -> None:
    """A box of half the side ``half`` with the mass's symbol; ``index`` counts from 0."""
    box = {"boxstyle": "round,pad=0,rounding_size=0.08", "fc": colour, "ec": style.BLACK, "lw": 0.7, "zorder": 3}
    axes.add_patch(FancyBboxPatch((centre[0] - half, centre[1] - half), 2 * half, 2 * half, **box))
    axes.text(*centre, f"$m_{{{index + 1}}}$", ha="center", va="center", zorder=4)


def _wall(axes: Axes, corner: Point, width: float, height: float) -> None:
    axes.add_patch(Rectangle(corner, width, height, fc="white", ec=style.GREY, hatch="//////", lw=0.0))


def _host_with_resonator(axes: Axes, centre: Point, cell: UnitCell) -> None:
    """The host as a box with two stops, the resonator between them on its spring."""
    x, y = centre
    reach, outer = HALF * 0.82, HALF * 0.82 + GAP

    def box(dx: float, dy: float, width: float, height: float, colour: str, zorder: int) -> None:
        axes.add_patch(Rectangle((x + dx, y + dy), width, height, fc=colour, ec=style.BLACK, lw=0.7, zorder=zorder))

    box(-WIDE, -TALL, 2 * WIDE, 2 * TALL, style.SKY, 3)
    box(0.1 - WIDE, 0.1 - TALL, 2 * WIDE - 0.2, 2 * TALL - 0.2, "white", 3)
    for left, bottom in itertools.product((-outer - 0.1, outer), (-0.52, 0.2)):
        box(left, bottom, 0.1, 0.32, style.SKY, 4)
    stiffness = sum(s.stiffness for s in cell.springs if cell.resonator in (s.start, s.end))
    _spring(axes, [(x - WIDE + 0.1, y), (x - reach, y)], "", turns=3, height=0.09)
    box(-reach, -reach, 2 * reach, 2 * reach, style.ORANGE, 5)
    axes.text(x, y, f"$m_{{{cell.resonator + 1}}}$", ha="center", va="center", zorder=6)
    line = {"arrowstyle": "-", "color": style.VERMILION, "lw": 0.6, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("Δ", (x + reach + GAP / 2, y + 0.36), (x + reach + GAP / 2, y + TALL + 0.2), ha="center",
                  fontsize=7, color=style.VERMILION, zorder=7, arrowprops=line)  # fmt: skip
    masses = (f"$m_{{{i + 1}}}$ {with_prefix(1e3 * cell.masses[i], 'g')}" for i in (cell.host, cell.resonator))
    text = f"{',  '.join(masses)}\ninner spring {with_prefix(stiffness, 'N/m')}"
    axes.text(x, y - TALL - 0.08, text, ha="center", va="top", linespacing=1.3)


def _spring(axes: Axes, corners: Sequence[Point], text: str, turns: int = 5, height: float = 0.13) -> None:
    """A line through ``corners``, a zigzag with straight leads on its longest leg, its stiffness beside it."""
    legs = np.stack([corners[:-1], corners[1:]], axis=1)
    longest = int(np.argmax(np.hypot(*(legs[:, 1] - legs[:, 0]).T)))
    for leg in np.delete(legs, longest, axis=0):
        axes.plot(*leg.T, zorder=2, **ROD)
    start, along = legs[longest, 0], legs[longest, 1] - legs[longest, 0]
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.concatenate([[0, 0.2], 0.2 + 0.6 * (np.arange(2 * turns) + 0.5) / (2 * turns), [0.8, 1]])
    swing = np.zeros(len(s))
    swing[2:-2] = height * (-1.0) ** np.arange(2 * turns)
    points = start + s[:, None] * along + swing[:, None] * across
    axes.plot(*points.T, zorder=2 if height > 0.1 else 6, solid_joinstyle="round", **ROD)
    upright = abs(along[1]) > abs(along[0])
    shift, alignment = ((0.2, 0), ("left", "center")) if upright else ((0, 0.2), ("center", "bottom"))
    axes.text(*(start + along / 2 + shift), text, ha=alignment[0], va=alignment[1])


def draw_lattice(axes: Axes, chain: Chain, drive_cell: int = 0, gaps: Gaps = ()) -> None:
    """The lattice as a strip: its ends, drive (0-based cell) and contacts with their cells and clearances.

    ``gaps`` in m are those of the sides + and -, where they differ.
    """
    n = chain.cells
    axes.add_patch(Rectangle((0.5, 0), n, 1, fc="#EEEEEE", ec=style.BLACK, lw=0.6))
    if n <= 150:
        axes.vlines(np.arange(1, n) + 0.5, 0, 1, color="white", lw=0.5)
    if chain.ends == "fixed":
        for wall in (0.5 - 0.02 * n, n + 0.5):
            _wall(axes, (wall, -0.25), 0.02 * n, 1.5)
        axes.vlines([0.5, n + 0.5], -0.25, 1.25, color=style.BLACK, lw=1.0)
    arrow = {"arrowstyle": "-|>", "color": style.BLUE, "lw": 0.8}
    axes.annotate("", (drive_cell + 1, 1), (drive_cell + 1 + 0.025 * n, 1.75), arrowprops=arrow)
    last, width = -np.inf, max(0.006 * n, 1)
    texts = describe_stops(gaps, ()) if gaps else [f"{1e3 * clearance:#.3g}" for clearance in chain.clearances]
    for site, text in sorted(zip(chain.sites, texts, strict=True)):
        axes.add_patch(Rectangle((site + 1 - width / 2, 0), width, 1, fc=style.VERMILION, lw=0))
        # Labels need about a twentieth of the strip each; neighbouring sites go without.
        if site - last > 0.06 * n:
            axes.text(site + 1, 1.2, f"{site + 1}", ha="center", va="bottom", fontsize=7)
            below = {"color": style.VERMILION, "ha": "center", "va": "top", "linespacing": 1.0}
            axes.text(site + 1, -0.2, "0" if text in ("+0", "-0") else text.replace(" ", "\n"), **below)
            last = site
    if not chain.sites:
        axes.text(n / 2, -0.2, "no contact sites", color=style.GREY, ha="center", va="top")
    axes.set(xlim=(-0.035 * n, 1.035 * n), ylim=(-1.2, 2.3))
    axes.set_axis_off()
