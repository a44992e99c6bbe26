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
from vipetsc.case.contacts import has_equal_sides
from vipetsc.figures import style
from vipetsc.figures.page import Page, add_letters
from vipetsc.figures.panels import band_diagram, note
from vipetsc.figures.style import with_prefix
from vipetsc.lattice import Chain, Spring, UnitCell
from vipetsc.lattice.cell import GROUND
from vipetsc.lattice.sites import Pair
from vipetsc.wording import counted

# Lengths in units of the drawing.
PITCH = 2.0  # distance between neighbouring masses
HALF = 0.34  # half the side of a mass
WIDE = 1.0  # half the width of a host that holds its resonator
TALL = 0.62  # half its height
GAP = 0.17  # clearance as drawn
NEXT = 0.9  # from the border of a cell to the first mass of the next one
FOOT = 2.2 * HALF  # from the middle of a mass to the ground below it
MOST_SPRINGS = 24  # of a cell that is drawn: a cell from matrices has more
SIDE = 0.5  # half the side of a mass of the reduced model

STRIP = 0.52  # height in inches of a lattice drawn as a strip of cells
LEGEND = "above: cell; below: clearance in mm; arrow: drive"
ROD = {"color": style.BLACK, "lw": 0.7}  # the look of a spring's line
DISTANCE = 0.2  # from the middle of a spring to its text, in units of the drawing
LEVEL = 0.01  # component of a unit vector up to which it counts as zero
Point = tuple[float, float]


def unit_cell(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw the unit cell of the run's lattice and, below it, the lattice with ends, drive and contact sites."""
    case = Case.of(run)
    if case.lattice.cell is not None and case.lattice.cell.from_strip is not None:
        raise style.NoPicture("the cell of a strip is a row of cells of the plane; snapshots show its sites and drives")
    model = case.model()
    if len(model.chain.cell.springs) > MOST_SPRINGS:
        raise style.NoPicture(f"needs a cell of at most {MOST_SPRINGS} springs")
    page = Page.of(rows=2, width=style.PAGE, height=2.7, height_ratios=(2.1, 1))
    upper, lower = page.panels
    pairs: list[Pair] = []
    if model.chain.has_own_pairs:
        pairs = [*dict.fromkeys(model.chain.sites.pairs)]
    draw_unit_cell(upper, model.chain.cell, pairs)
    # The arrow of a wall that moves points at the wall.
    cells = model.chain.cells
    walls = {"left": -0.5 - 0.01 * cells, "right": cells - 0.5 + 0.01 * cells}
    driven = walls.get(Case.of(run).drive.end or "", model.drive_cell)
    draw_lattice(lower, model.chain, driven)

    title = "Unit cell"
    differing = int(model.chain.differs.sum())
    if differing:
        title += f" of the case; {counted(differing, 'cell')} differ"
    upper.set_title(title)
    legend = LEGEND if model.drive.amplitude else LEGEND.replace("arrow: drive", "arrow: initial motion")
    lower.set_title(f"Lattice of {model.chain.cells} cells, {model.chain.ends} ends; sites: {legend}")
    return page.lettered()


def lattice_page(case: Case, sites: tuple[int, ...]) -> Figure:
    """Draw the cell, its dispersion with the drive marked, and the lattice with each of these numbers of ``sites``."""
    strips = STRIP * len(sites)
    figure = style.new_figure(style.PAGE, 2.9 + strips)
    upper, lower = figure.subfigures(2, 1, height_ratios=(2.9, strips))
    left, right = upper.subplots(1, 2, width_ratios=(1.55, 1))
    cell = case.lattice.unit_cell()
    draw_unit_cell(left, cell)
    left.set_title(f"Unit cell, {case.lattice.reading} reading")
    band_diagram(right, cell, case.drive.frequency)
    right.set_title("Bands; gaps shaded, drive dotted")

    rows = lower.subplots(len(sites), 1, squeeze=False).ravel()
    for axes, count in zip(rows, sites, strict=True):
        model = case.varied(contacts={"sites": count, "clearance": None}).model()
        draw_lattice(axes, model.chain, model.drive_cell)
        axes.set_title(counted(count, "contact site"))
    rows[0].set_title(f"{rows[0].get_title('left')}; {LEGEND}")
    add_letters([left, right, rows])
    return figure


def reduced_model(masses: tuple[float, float], springs: tuple[float, float], clearance: float) -> Figure:
    """Draw the 2-DoF model: a host held by a wall, and a resonator joined to it by a spring and the contact.

    ``masses`` in kg and ``springs`` in N/m are those of host and resonator, ``clearance`` is in m.
    """
    page = Page.of(width=style.PAGE * 0.72, height=1.7)
    (axes,) = page.panels
    host = 2.6
    resonator = 6.6
    start = host + SIDE
    end = resonator - SIDE

    draw_wall(axes, (-0.35, -0.8), 0.35, 1.9)
    axes.plot([0, 0], [-0.8, 1.1], color=style.BLACK, lw=1.0)
    draw_spring(axes, [(0, 0), (host - SIDE, 0)], rf"$k_1$ = {with_prefix(springs[0], 'N/m')}")
    draw_spring(axes, [(start, 0.26), (end, 0.26)], rf"$k_2$ = {with_prefix(springs[1], 'N/m')}")

    # The contact as two stops that face each other over a gap.
    middle = (start + end) / 2
    half_gap = 0.16
    for edge, stop in ((start, middle - half_gap), (end, middle + half_gap)):
        axes.plot([edge, stop], [-0.3, -0.3], color=style.VERMILION, lw=1.0)
        axes.plot([stop, stop], [-0.46, -0.14], color=style.VERMILION, lw=2.0)
    text = f"contact on both sides, Δ = {1e3 * clearance:.4g} mm"
    axes.text(middle, -0.56, text, ha="center", va="top", color=style.VERMILION)

    # The arrows show the directions of the displacements.
    for i, (x, mass, colour) in enumerate(zip((host, resonator), masses, (style.SKY, style.ORANGE), strict=True)):
        _draw_mass(axes, (x, 0), SIDE, i, colour)
        axes.text(x, -SIDE - 0.06, with_prefix(1e3 * mass, "g"), ha="center", va="top")
        arrow = {"arrowstyle": "<|-", "lw": 0.8, "color": style.BLUE, "shrinkA": 0, "shrinkB": 0}
        axes.annotate(f"$u_{i + 1}$", (x, 0.85), (x + 0.95, 0.85), va="center", color=style.BLUE, arrowprops=arrow)
    axes.set(xlim=(-0.5, 8.0), ylim=(-0.95, 1.2), aspect="equal")
    axes.set_axis_off()
    return page.lettered()


class SpringEnd(NamedTuple):
    """The end of a spring: the middle of a mass and half the mass's width, or a place on the cell's border and 0."""

    x: float
    y: float
    half: float


class CellLayout(NamedTuple):
    """The centres of masses and half their widths, by number, and the cell's borders ``left`` and ``right`` along x.

    ``nested``: whether the resonator sits inside its host.
    """

    centre: dict[int, Point]
    half: dict[int, float]
    left: float
    right: float
    nested: bool

    def end_at(self, mass: int) -> SpringEnd:
        """Return the end of a spring at a mass."""
        x, y = self.centre[mass]
        return SpringEnd(x, y, self.half[mass])

    def corners(self, first: SpringEnd, second: SpringEnd, level: float) -> list[Point]:
        """Return the line of a spring, which goes round masses between its ends at the height ``level``."""
        a, b = sorted((first, second))
        if abs(a.x - b.x) < 0.1:
            # b stands above a.
            below_b = TALL if b.half == WIDE else HALF
            return [(b.x, b.y - below_b), (a.x, a.y + HALF)]
        if abs(a.y - b.y) >= 0.1:
            # From corner to corner of the two masses.
            dx, dy = 1.3 * HALF * np.array([b.x - a.x, b.y - a.y]) / np.hypot(b.x - a.x, b.y - a.y)
            return [(a.x + dx, a.y + dy), (b.x - dx, b.y - dy)]

        is_blocked = any(a.x < x < b.x and abs(y - a.y) < 0.1 for x, y in self.centre.values())
        if not is_blocked:
            return [(a.x + a.half, a.y), (b.x - b.half, b.y)]

        # Above the masses on the line, below those that hang from it.
        edge = a.y + HALF
        height = level
        if a.y != 0:
            edge = a.y - HALF
            height = a.y - 2.4 * HALF
        line = [(a.x, height), (b.x, height)]
        if a.half > 0:
            line.insert(0, (a.x, edge))
        if b.half > 0:
            line.append((b.x, edge))
        return line


def draw_unit_cell(axes: Axes, cell: UnitCell, pairs: Sequence[Pair] = ()) -> None:
    """Draw masses and springs of ``cell``, and the contacts of ``pairs``, by default of its host and resonator.

    A resonator that is joined to its host alone is drawn inside it.
    """
    layout = _layout(cell)
    nested_pair = {cell.host, cell.resonator} if layout.nested else set()
    highest = _draw_springs(axes, cell, layout, nested_pair)

    for mass, (x, y) in layout.centre.items():
        if mass not in nested_pair:
            colour = {cell.resonator: style.ORANGE, cell.host: style.SKY}.get(mass, style.PALE)
            _draw_mass(axes, (x, y), HALF, mass, colour)
            # Left of the lower left corner, clear of what hangs below it and of the spring on its left.
            text = with_prefix(1e3 * cell.masses[mass], "g")
            axes.text(x - HALF - 0.05, y - HALF, text, ha="right", va="center", zorder=4)

    host = layout.centre[cell.host]
    resonator = layout.centre[cell.resonator]
    inner = cell.pair
    if layout.nested:
        _draw_host_with_resonator(axes, host, cell, has_stops=not pairs or inner in pairs)
    elif cell.host != cell.resonator and not pairs:
        _draw_contact(axes, host, resonator)
    for pair in pairs:
        # The stops of a nested resonator are in its host.
        if not (layout.nested and pair == inner):
            _draw_pair(axes, layout, pair)

    low = min(y for _, y in layout.centre.values()) - TALL - 0.55
    if cell.is_grounded:
        low -= FOOT
    high = highest + 0.5
    borders = [layout.left, layout.right]
    axes.vlines(borders, low + 0.15, high - 0.1, color=style.GREY, lw=0.6, ls=style.DASHED)
    axes.text(layout.left + 0.07, low + 0.1, "one cell", color=style.GREY, va="bottom")
    beyond = NEXT + 2 * HALF if any(pair.offset for pair in pairs) else 0.0
    axes.set(xlim=(layout.left - 0.5, layout.right + beyond + 0.5), ylim=(low, high), aspect="equal")
    axes.set_axis_off()


def _draw_pair(axes: Axes, layout: CellLayout, pair: Pair) -> None:
    """Draw the contact of a ``pair``: within the cell, with a mass of the next cell, or with the ground."""
    x, y = layout.centre[pair.resonator]
    if pair.host < 0:
        # A post on the ground that stops the mass, below what is tied to the mass.
        edge = x + layout.half[pair.resonator] + GAP
        axes.add_patch(Rectangle((edge, y - 2 * HALF), 0.12, 2 * HALF - 0.1, fc=style.VERMILION, lw=0, zorder=3))
        draw_wall(axes, (edge - 0.3, y - 2 * HALF - 0.2), 0.72, 0.2)
        axes.text(edge + 0.2, y - HALF, "contact, Δ", color=style.VERMILION, va="center")
        return
    if not pair.offset:
        _draw_contact(axes, layout.centre[pair.host], (x, y))
        return

    # The mass of the next cell as it stands behind the border, in dashes.
    ghost = layout.right + NEXT + HALF
    look = {"fc": "white", "ec": style.GREY, "ls": style.DASHED, "lw": 0.7, "zorder": 3}
    axes.add_patch(Rectangle((ghost - HALF, y - HALF), 2 * HALF, 2 * HALF, **look))
    axes.text(ghost, y, f"$m_{{{pair.resonator + 1}}}$", ha="center", va="center", color=style.GREY, zorder=4)
    start = layout.end_at(pair.host)
    middle = 0.5 * (start.x + start.half + ghost - HALF)
    # Two stops that face each other, below the springs between these masses.
    level = y - 0.55 * HALF
    for edge, stop in ((start.x + start.half, middle - 0.5 * GAP), (ghost - HALF, middle + 0.5 * GAP)):
        axes.plot([edge, stop], [level, level], color=style.VERMILION, lw=1.0)
        axes.plot([stop, stop], [level - 0.16, level + 0.16], color=style.VERMILION, lw=2.0)
    axes.text(layout.right - 0.08, level - 0.24, "contact, Δ", color=style.VERMILION, ha="right", va="top")


def _draw_springs(axes: Axes, cell: UnitCell, layout: CellLayout, nested_pair: set[int]) -> float:
    """Draw the springs of ``cell`` but that of the ``nested_pair``; return the height that they reach."""
    # Each spring above masses takes a level of its own.
    level = TALL + 0.6
    highest = TALL
    for spring in cell.springs:
        if not spring.offset and {spring.start, spring.end} == nested_pair:
            continue
        end = layout.end_at(spring.end)
        if spring.start == GROUND:
            # Beside the middle, where the spring to a mass that hangs below begins.
            x = end.x - 0.6 * HALF
            edge = end.y - (TALL if end.half == WIDE else HALF)
            ground = edge - FOOT
            draw_spring(axes, [(x, edge), (x, ground)], "")
            axes.text(x - 0.18, ground, with_prefix(spring.stiffness, "N/m"), ha="right", va="bottom")
            draw_wall(axes, (x - 0.3, ground - 0.2), 0.6, 0.2)
            continue
        start = layout.end_at(spring.start)
        text = with_prefix(spring.stiffness, "N/m")
        if spring.offset:
            # One zigzag up to the right border, and the end of that of the cell before.
            leaving = layout.corners(start, SpringEnd(layout.right, start.y, 0), level)
            arriving = layout.corners(SpringEnd(layout.left, end.y, 0), end, level)
            draw_spring(axes, leaving, text)
            draw_spring(axes, arriving, "", turns=0)
            for (x, y), direction in ((leaving[-1], 1), (arriving[0], -1)):
                axes.plot([x, x + 0.4 * direction], [y, y], ls=(0, (1, 1.5)), zorder=2, **ROD)
            goes_round = len(leaving) > 2 or len(arriving) > 2
        else:
            corners = layout.corners(start, end, level)
            draw_spring(axes, corners, text)
            goes_round = len(corners) > 2
        if goes_round:
            highest = max(highest, level)
            level += 0.55
    return highest


def _draw_contact(axes: Axes, host: Point, resonator: Point) -> None:
    """Draw a bowed double arrow between the masses of a contact whose resonator is not inside its host."""
    arrow = {
        "arrowstyle": "<->",
        "color": style.VERMILION,
        "lw": 0.9,
        "ls": (0, (3, 1.5)),
        "shrinkA": 9,
        "shrinkB": 9,
        "connectionstyle": "arc3,rad=0.45",
    }
    axes.annotate("", resonator, host, zorder=2, arrowprops=arrow)
    middle = np.mean([host, resonator], axis=0)
    note(axes, "contact, Δ", middle, (-16, 0), ha="right", va="center", color=style.VERMILION)


def _layout(cell: UnitCell) -> CellLayout:
    """Return a layout with the shortest chain of springs through the cell on one line, the other masses below it.

    The place of a mass along the line is the number of springs from where the chain begins to the mass.
    """
    held_by = [spring for spring in cell.springs if cell.resonator in (spring.start, spring.end)]
    pair = {cell.host, cell.resonator}
    nested = bool(held_by) and all({s.start, s.end} == pair and not s.offset for s in held_by)

    joined = np.zeros((cell.dofs, cell.dofs), bool)
    for spring in cell.springs:
        if spring.start != GROUND:
            joined[spring.start, spring.end] |= not spring.offset
    through = next((s for s in cell.springs if s.offset), Spring(cell.dofs - 1, 0, 1.0, offset=1))
    # A wave comes into the cell at the end of the spring to the next cell, and leaves at its start. The numbers of
    # springs from the one and to the other have the least sum for masses on the shortest chain.
    ends = [through.end, through.start]
    passed, ahead = shortest_path(csr_array(joined), directed=False, unweighted=True, indices=ends)

    # A mass that no spring within the cell joins to the others stands behind them.
    reached = np.isfinite(passed)
    depth = np.where(reached, passed, np.max(passed, where=reached, initial=0) + 1)

    # A host with its resonator inside is wider by 2 ``extra``: its centre moves by ``extra``, what stands behind it by
    # twice as much.
    extra = WIDE - HALF if nested else 0.0
    centre: dict[int, Point] = {}
    for mass in range(cell.dofs):
        if nested and mass == cell.resonator:
            continue
        x = PITCH * depth[mass] + extra * (1 + np.sign(depth[mass] - depth[cell.host]))
        on_line = passed[mass] + ahead[mass] == passed[through.start]
        y = 0.0 if on_line else -0.75 * PITCH
        # Masses at one place along the line hang below each other.
        while (x, y) in centre.values():
            y -= 0.75 * PITCH
        centre[mass] = (x, y)

    half = dict.fromkeys(centre, HALF)
    if nested:
        centre[cell.resonator] = centre[cell.host]
        half[cell.resonator] = HALF
        half[cell.host] = WIDE
    left = min(x - half[mass] for mass, (x, _) in centre.items()) - 0.9
    right = max(x + half[mass] for mass, (x, _) in centre.items()) + 1.5
    return CellLayout(centre=centre, half=half, left=left, right=right, nested=nested)


def _draw_mass(axes: Axes, centre: Point, half: float, index: int, colour: str) -> None:
    """Draw a box of half the side ``half`` with the mass's symbol; ``index`` counts from 0."""
    corner = (centre[0] - half, centre[1] - half)
    look = {"boxstyle": "round,pad=0,rounding_size=0.08", "fc": colour, "ec": style.BLACK, "lw": 0.7, "zorder": 3}
    axes.add_patch(FancyBboxPatch(corner, 2 * half, 2 * half, **look))
    axes.text(*centre, f"$m_{{{index + 1}}}$", ha="center", va="center", zorder=4)


def _draw_host_with_resonator(axes: Axes, centre: Point, cell: UnitCell, has_stops: bool) -> None:
    """Draw the host as a box, the resonator inside on its spring, and the two stops between which it moves, if any."""
    x, y = centre
    reach = HALF * 0.82
    outer = reach + GAP

    def box(dx: float, dy: float, width: float, height: float, colour: str, zorder: int) -> None:
        axes.add_patch(Rectangle((x + dx, y + dy), width, height, fc=colour, ec=style.BLACK, lw=0.7, zorder=zorder))

    # From behind to the front: the host as a frame, its stops, the spring, the resonator.
    box(-WIDE, -TALL, 2 * WIDE, 2 * TALL, style.SKY, zorder=3)
    box(0.1 - WIDE, 0.1 - TALL, 2 * WIDE - 0.2, 2 * TALL - 0.2, "white", zorder=3)
    draw_spring(axes, [(x - WIDE + 0.1, y), (x - reach, y)], "", turns=3, height=0.09, zorder=6)
    box(-reach, -reach, 2 * reach, 2 * reach, style.ORANGE, zorder=5)
    axes.text(x, y, f"$m_{{{cell.resonator + 1}}}$", ha="center", va="center", zorder=6)

    if has_stops:
        for left, bottom in itertools.product((-outer - 0.1, outer), (-0.52, 0.2)):
            box(left, bottom, 0.1, 0.32, style.SKY, zorder=4)
        gap = x + reach + GAP / 2
        line = {"arrowstyle": "-", "color": style.VERMILION, "lw": 0.6, "shrinkA": 0, "shrinkB": 0}
        text = {"ha": "center", "fontsize": 7, "color": style.VERMILION, "zorder": 7}
        axes.annotate("Δ", (gap, y + 0.36), (gap, y + TALL + 0.2), arrowprops=line, **text)

    masses = [f"$m_{{{i + 1}}}$ {with_prefix(1e3 * cell.masses[i], 'g')}" for i in (cell.host, cell.resonator)]
    stiffness = sum(s.stiffness for s in cell.springs if cell.resonator in (s.start, s.end))
    caption = f"{',  '.join(masses)}\ninner spring {with_prefix(stiffness, 'N/m')}"
    axes.text(x, y - TALL - 0.08, caption, ha="center", va="top", linespacing=1.3)


def draw_spring(
    axes: Axes, corners: Sequence[Point], text: str, turns: int = 5, height: float = 0.13, zorder: int = 2
) -> None:
    """Draw a spring along ``corners``: a zigzag with straight leads on the longest leg, and ``text`` next to it.

    The zigzag has ``turns`` turns, ``height`` to either side.
    """
    legs = np.stack([corners[:-1], corners[1:]], axis=1)
    lengths = np.hypot(*(legs[:, 1] - legs[:, 0]).T)
    longest = int(np.argmax(lengths))
    for leg in np.delete(legs, longest, axis=0):
        axes.plot(*leg.T, zorder=2, **ROD)

    start = legs[longest, 0]
    along = legs[longest, 1] - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    # Straight leads of a fifth of the leg at either end; between them two turning points for each turn, at equal
    # distances, on either side of the leg alternately.
    position = np.concatenate([[0, 0.2], 0.2 + 0.6 * (np.arange(2 * turns) + 0.5) / (2 * turns), [0.8, 1]])
    swing = np.zeros(len(position))
    swing[2:-2] = height * (-1.0) ** np.arange(2 * turns)
    points = start + position[:, None] * along + swing[:, None] * across
    axes.plot(*points.T, zorder=zorder, solid_joinstyle="round", **ROD)

    _write_beside(axes, start + along / 2, across, text)


def _write_beside(axes: Axes, middle: np.ndarray, across: np.ndarray, text: str) -> None:
    """Write ``text`` next to the ``middle`` of a spring's leg: above the leg, or on the right of an upright one.

    ``across`` is a unit vector at right angles to the leg.
    """
    is_upright = abs(across[1]) < LEVEL
    points_up = across[0] > 0 if is_upright else across[1] > 0
    side = across if points_up else -across
    place = {"ha": "center", "va": "bottom"}
    # The text of an oblique leg begins, or ends, beside the leg: a text above its middle would lie on the zigzag.
    if side[0] > LEVEL:
        place["ha"] = "left"
    elif side[0] < -LEVEL:
        place["ha"] = "right"
    if is_upright:
        place["va"] = "center"
    axes.text(*(middle + DISTANCE * side), text, **place)


def draw_lattice(axes: Axes, chain: Chain, drive_cell: float) -> None:
    """Draw the lattice as a strip: its ends, drive and contacts with their cells and clearances.

    ``drive_cell`` is 0-based, and lies beyond the last cell where a wall moves. Cells have a width of 1 on the axis,
    and the strip a height of 1.
    """
    n = chain.cells
    axes.add_patch(Rectangle((0.5, 0), n, 1, fc="#EEEEEE", ec=style.BLACK, lw=0.6))
    # Borders of more cells would merge.
    if n <= 150:
        axes.vlines(np.arange(1, n) + 0.5, 0, 1, color="white", lw=0.5)
    if chain.ends == "fixed":
        for wall in (0.5 - 0.02 * n, n + 0.5):
            draw_wall(axes, (wall, -0.25), 0.02 * n, 1.5)
        axes.vlines([0.5, n + 0.5], -0.25, 1.25, color=style.BLACK, lw=1.0)

    # The arrow of the drive ends on the strip, or above the number of a site in the driven cell or next to it.
    near = min((abs(site.cell - drive_cell) for site in chain.sites), default=n)
    tip = 1.8 if near < 0.03 * n else 1.0
    arrow = {"arrowstyle": "-|>", "color": style.BLUE, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (drive_cell + 1, tip), (drive_cell + 1 + 0.02 * n, tip + 0.7), arrowprops=arrow)

    if chain.sites:
        _draw_sites(axes, chain)
    else:
        axes.text(n / 2, -0.2, "no contact sites", color=style.GREY, ha="center", va="top")
    axes.set(xlim=(0.5 - 0.035 * n, 0.5 + 1.035 * n), ylim=(-1.2, 2.6))
    axes.set_axis_off()


def _draw_sites(axes: Axes, chain: Chain) -> None:
    """Draw a mark for every site, with its cell above and its clearance in mm below where there is room."""
    n = chain.cells
    width = min(max(0.006 * n, 1), 0.02 * n)
    gaps = chain.sites.gaps
    if has_equal_sides(gaps):
        texts = [f"{1e3 * gap:#.3g}" for gap, _ in gaps]
    else:
        texts = [_gap_label(plus, minus) for plus, minus in gaps]
    # From the left to the right, so that the first of a group of sites has the label.
    last_labelled = -np.inf
    for site, text in sorted(zip(chain.sites.cells.tolist(), texts, strict=True)):
        axes.add_patch(Rectangle((site + 1 - width / 2, 0), width, 1, fc=style.VERMILION, lw=0))

        # A label takes about a twentieth of the strip: sites next to one with a label have none.
        if site - last_labelled > 0.06 * n:
            axes.text(site + 1, 1.2, f"{site + 1}", ha="center", va="bottom", fontsize=7)
            below = {"color": style.VERMILION, "ha": "center", "va": "top", "linespacing": 1.0}
            axes.text(site + 1, -0.2, text, **below)
            last_labelled = site


def _gap_label(plus: float, minus: float) -> str:
    """Return the clearances in mm of a site's stops by their side, a line each; a stop that touches is 0."""
    lines = []
    for side, gap in (("+", plus), ("-", minus)):
        if np.isfinite(gap):
            # "+ 0.5": the stop on the side +, 0.5 mm away. The clearance of a pressed stop is negative: "+ -0.5".
            lines.append(f"{side} {1e3 * gap:.4g}" if gap else "0")
    return "\n".join(lines)


def draw_wall(axes: Axes, corner: tuple[float, float], width: float, height: float) -> None:
    """Draw a hatched wall from its lower left ``corner`` on."""
    axes.add_patch(Rectangle(corner, width, height, fc="white", ec=style.GREY, hatch="//////", lw=0.0))
