"""The unit cell drawn as masses and springs with its clearance, above the lattice with its sites."""

from __future__ import annotations

import itertools

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from vipetsc.figures import style
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import Chain, UnitCell

PITCH = 2.0  # distance between neighbouring masses of the drawing
HALF = 0.34  # half the side of a mass
WIDE = 1.0  # half the width of a host that holds its resonator
ROOM = 0.62  # half its height
GAP = 0.17  # clearance as drawn


def unit_cell(run: RunFile, analysis: h5py.File | None) -> Figure:
    """The unit cell of the run's lattice and, below it, the lattice with ends, drive and contact sites."""
    model = run.model
    figure = style.new_figure(style.PAGE, 2.7)
    upper, lower = figure.subplots(2, 1, gridspec_kw={"height_ratios": (2.1, 1)})
    draw_unit_cell(upper, model.chain.cell)
    draw_lattice(lower, model.chain, model.drive_cell)
    style.letter(upper, "(a) Unit cell")
    style.letter(lower, f"(b) Lattice of {model.chain.cells} cells, {model.chain.ends} ends")
    return figure


def draw_unit_cell(axes: Axes, cell: UnitCell) -> None:
    """Masses, springs and the contact pair of ``cell``; a resonator held by its host alone sits inside it."""
    inside = _held_inside(cell)
    place = _places(cell, inside)
    half = {i: WIDE if inside and i == cell.host else HALF for i in place}
    left = min(x - half[i] for i, (x, _) in place.items()) - 0.9
    right = max(x + half[i] for i, (x, _) in place.items()) + 1.5
    level, highest = ROOM + 0.6, ROOM
    for spring in cell.springs:
        a, b, text = spring.start, spring.end, with_prefix(spring.stiffness, "N/m")
        if inside and {a, b} == {cell.host, cell.resonator} and not spring.next_cell:
            continue
        if spring.next_cell:
            for mass, wall, side in ((a, right, 1), (b, left, -1)):
                (x, y), edge = place[mass], half[mass]
                blocked = any(side * (p - x) > 0 and abs(q - y) < 0.1 for p, q in place.values())
                if blocked:
                    _route(axes, [(x, y + HALF), (x, level), (wall, level)], text)
                    highest = level
                else:
                    _lead(axes, (x + side * edge, y), (wall, y), text if side > 0 else "")
            continue
        (xa, ya), (xb, yb) = sorted((place[a], place[b]))
        between = any(xa < p < xb and abs(q - ya) < 0.1 for p, q in place.values())
        if abs(ya - yb) < 0.1 and not between:
            first, last = sorted((a, b), key=lambda i: place[i])
            draw_spring(axes, (xa + half[first], ya), (xb - half[last], yb), text)
        elif abs(xa - xb) < 0.1:
            top, bottom = sorted((a, b), key=lambda i: -place[i][1])
            drop = ROOM if inside and top == cell.host else HALF
            draw_spring(axes, (xa, place[top][1] - drop), (xb, place[bottom][1] + HALF), text)
        elif abs(ya - yb) < 0.1:
            _route(axes, [(xa, ya + HALF), (xa, level), (xb, level), (xb, yb + HALF)], text)
            highest, level = level, level + 0.55
        else:
            short = 1.3 * HALF * np.array([xb - xa, yb - ya]) / np.hypot(xb - xa, yb - ya)
            draw_spring(axes, tuple(np.array([xa, ya]) + short), tuple(np.array([xb, yb]) - short), text)
    for i, (x, y) in place.items():
        if not (inside and i in (cell.host, cell.resonator)):
            _mass(axes, x, y, i, cell.masses[i], cell)
    if inside:
        _host_with_resonator(axes, place[cell.host], cell)
    else:
        _contact_link(axes, place[cell.host], place[cell.resonator])
    low = min(y for _, y in place.values()) - ROOM - 0.55
    high = highest + 0.5
    for wall in (left, right):
        axes.plot([wall, wall], [low + 0.15, high - 0.1], color=style.GREY, lw=0.6, ls=(0, (4, 3)))
    axes.text(left + 0.07, low + 0.1, "one cell", color=style.GREY, fontsize=6.5, va="bottom")
    axes.set(xlim=(left - 0.5, right + 0.5), ylim=(low, high), aspect="equal")
    axes.set_axis_off()


def _held_inside(cell: UnitCell) -> bool:
    """Whether springs join the resonator to its host and to nothing else."""
    pairs = [({s.start, s.end}, s.next_cell) for s in cell.springs if cell.resonator in (s.start, s.end)]
    return bool(pairs) and all(pair == {cell.host, cell.resonator} and not out for pair, out in pairs)


def _places(cell: UnitCell, inside: bool) -> dict[int, tuple[float, float]]:
    """Position of every mass: the shortest way through the cell on one line, the others below it."""
    neighbours: dict[int, list[int]] = {i: [] for i in range(cell.dofs)}
    for s in cell.springs:
        if not s.next_cell:
            neighbours[s.start].append(s.end)
            neighbours[s.end].append(s.start)
    through = next(s for s in cell.springs if s.next_cell)
    paths, line = [[through.end]], [through.end]
    reached = {through.end}
    while paths:
        path = paths.pop(0)
        if path[-1] == through.start:
            line = path
            break
        fresh = [i for i in neighbours[path[-1]] if i not in reached]
        reached.update(fresh)
        paths += [[*path, i] for i in fresh]
    place, x = {}, 0.0
    for i in line:
        x += (WIDE - HALF) * (inside and i == cell.host)
        place[i] = (x, 0.0)
        x += PITCH + (WIDE - HALF) * (inside and i == cell.host)
    if inside:
        place.setdefault(cell.host, (x, 0.0))
        place[cell.resonator] = place[cell.host]
    while len(place) < cell.dofs:
        # A mass off the line hangs below one that is placed already, or stands at the end of the line.
        i = next((i for i in range(cell.dofs) if i not in place and set(neighbours[i]) & place.keys()), None)
        if i is None:
            i = next(i for i in range(cell.dofs) if i not in place)
            place[i] = (max(p for p, _ in place.values()) + PITCH, 0.0)
            continue
        above = place[next(j for j in neighbours[i] if j in place)]
        spot = (above[0], above[1] - 0.75 * PITCH)
        while spot in place.values():
            spot = (spot[0] + 0.5 * PITCH, spot[1])
        place[i] = spot
    return place


def _mass(axes: Axes, x: float, y: float, index: int, mass: float, cell: UnitCell) -> None:
    colour = {cell.host: style.SKY, cell.resonator: style.ORANGE}.get(index, style.PALE)
    look = {"boxstyle": "round,pad=0,rounding_size=0.08", "fc": colour, "ec": style.BLACK, "lw": 0.7, "zorder": 3}
    axes.add_patch(FancyBboxPatch((x - HALF, y - HALF), 2 * HALF, 2 * HALF, **look))
    axes.text(x, y, f"$m_{{{index + 1}}}$", ha="center", va="center", zorder=4)
    # Beside the mass's lower left corner, clear of what hangs below it and of the spring on its left.
    axes.text(x - HALF - 0.05, y - HALF, with_prefix(1e3 * mass, "g"), ha="right", va="center", fontsize=6.5, zorder=4)


def _host_with_resonator(axes: Axes, centre: tuple[float, float], cell: UnitCell) -> None:
    """The host as a box with two stops, the resonator between them on its spring."""
    x, y = centre
    box = {"ec": style.BLACK, "lw": 0.7}
    axes.add_patch(Rectangle((x - WIDE, y - ROOM), 2 * WIDE, 2 * ROOM, fc=style.SKY, zorder=3, **box))
    axes.add_patch(
        Rectangle((x - WIDE + 0.1, y - ROOM + 0.1), 2 * WIDE - 0.2, 2 * ROOM - 0.2, fc="white", zorder=3, **box)
    )
    reach = HALF * 0.82
    for side in (-1, 1):
        stop = x + side * (reach + GAP)
        for end in (-1, 1):
            axes.add_patch(Rectangle((min(stop, stop + side * 0.1), y + (0.2 if end > 0 else -0.52)), 0.1, 0.32,
                                     fc=style.SKY, zorder=4, **box))  # fmt: skip
    stiffness = sum(s.stiffness for s in cell.springs if cell.resonator in (s.start, s.end))
    draw_spring(axes, (x - WIDE + 0.1, y), (x - reach, y), "", turns=3, height=0.09)
    axes.add_patch(Rectangle((x - reach, y - reach), 2 * reach, 2 * reach, fc=style.ORANGE, zorder=5, **box))
    axes.text(x, y, f"$m_{{{cell.resonator + 1}}}$", ha="center", va="center", zorder=6)
    axes.annotate("Δ", (x + reach + GAP / 2, y + 0.36), (x + reach + GAP / 2, y + ROOM + 0.2), ha="center",
                  fontsize=7, color=style.VERMILION, zorder=7,
                  arrowprops={"arrowstyle": "-", "color": style.VERMILION, "lw": 0.6,
                              "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    axes.text(x, y - ROOM - 0.08, f"$m_{{{cell.host + 1}}}$ {with_prefix(1e3 * cell.masses[cell.host], 'g')},  "
              f"$m_{{{cell.resonator + 1}}}$ {with_prefix(1e3 * cell.masses[cell.resonator], 'g')}\n"
              f"inner spring {with_prefix(stiffness, 'N/m')}",
              ha="center", va="top", fontsize=6.5, linespacing=1.3)  # fmt: skip


def _contact_link(axes: Axes, host: tuple[float, float], resonator: tuple[float, float]) -> None:
    """A bowed double arrow between the pair, for a resonator that other masses hold too."""
    axes.annotate("", resonator, host, zorder=2, arrowprops={
        "arrowstyle": "<->", "color": style.VERMILION, "lw": 0.9, "ls": (0, (3, 1.5)),
        "shrinkA": 9, "shrinkB": 9, "connectionstyle": "arc3,rad=0.45"})  # fmt: skip
    middle = (host[0] + resonator[0]) / 2, (host[1] + resonator[1]) / 2
    axes.annotate("contact, Δ", middle, (-16, 0), textcoords="offset points", ha="right", va="center",
                  fontsize=6.5, color=style.VERMILION)  # fmt: skip


def draw_spring(
    axes: Axes,
    start: tuple[float, float],
    end: tuple[float, float],
    text: str,
    turns: int = 5,
    height: float = 0.13,
) -> None:
    """A zigzag from ``start`` to ``end`` with straight leads, its stiffness beside it."""
    start, end = np.array(start), np.array(end)
    along = end - start
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.concatenate([[0, 0.2], 0.2 + 0.6 * (np.arange(2 * turns) + 0.5) / (2 * turns), [0.8, 1]])
    swing = np.zeros(len(s))
    swing[2:-2] = height * (-1.0) ** np.arange(2 * turns)
    points = start + s[:, None] * along + swing[:, None] * across
    axes.plot(*points.T, color=style.BLACK, lw=0.7, zorder=2 if height > 0.1 else 6, solid_joinstyle="round")
    if text:
        x, y = (start + end) / 2
        upright = abs(along[1]) > abs(along[0])
        axes.text(x + (0.2 if upright else 0), y + (0 if upright else 0.2), text, fontsize=6.5,
                  ha="left" if upright else "center", va="center" if upright else "bottom")  # fmt: skip


def _lead(axes: Axes, start: tuple[float, float], wall: tuple[float, float], text: str) -> None:
    """The way out of the cell: the spring to the next one if it has a ``text``, else the last one's end."""
    if text:
        draw_spring(axes, start, wall, text)
    else:
        axes.plot([start[0], wall[0]], [start[1], wall[1]], color=style.BLACK, lw=0.7, zorder=2)
    beyond = wall[0] + (0.4 if wall[0] > start[0] else -0.4)
    axes.plot([wall[0], beyond], [wall[1], wall[1]], color=style.BLACK, lw=0.7, ls=(0, (1, 1.5)), zorder=2)


def _route(axes: Axes, corners: list[tuple[float, float]], text: str) -> None:
    """A spring that goes round the masses in its way: a line through ``corners``, zigzag on the longest leg."""
    lengths = [np.hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(corners)]
    longest = int(np.argmax(lengths))
    for i, (a, b) in enumerate(itertools.pairwise(corners)):
        if i == longest:
            draw_spring(axes, a, b, text)
        else:
            axes.plot([a[0], b[0]], [a[1], b[1]], color=style.BLACK, lw=0.7, zorder=2)


def draw_lattice(axes: Axes, chain: Chain, drive_cell: int = 0, brief: bool = False) -> None:
    """The lattice as a strip of cells: how it ends, where it is driven (0-based cell), where contacts are.

    A ``brief`` one leaves out the words that several strips would repeat.
    """
    n = chain.cells
    axes.add_patch(Rectangle((0.5, 0), n, 1, fc="#EEEEEE", ec=style.BLACK, lw=0.6))
    if n <= 150:
        axes.vlines(np.arange(1, n) + 0.5, 0, 1, color="white", lw=0.5)
    if chain.ends == "fixed":
        for wall in (0.5 - 0.02 * n, n + 0.5):
            axes.add_patch(Rectangle((wall, -0.25), 0.02 * n, 1.5, fc="white", ec=style.GREY, hatch="//////", lw=0.0))
        axes.vlines([0.5, n + 0.5], -0.25, 1.25, color=style.BLACK, lw=1.0)
    axes.annotate("" if brief else "drive", (drive_cell + 1, 1), (drive_cell + 1 + 0.025 * n, 1.75),
                  ha="left", va="center", fontsize=7, color=style.BLUE,
                  arrowprops={"arrowstyle": "-|>", "color": style.BLUE, "lw": 0.8})  # fmt: skip
    last = -np.inf
    for site, clearance in sorted(zip(chain.sites, chain.clearances, strict=True)):
        width = max(0.006 * n, 1)
        axes.add_patch(Rectangle((site + 1 - width / 2, 0), width, 1, fc=style.VERMILION, lw=0))
        # Labels need about a tenth of the strip each; neighbouring sites go without.
        if site - last > 0.085 * n:
            axes.text(site + 1, 1.2, f"{site + 1}", ha="center", va="bottom", fontsize=7)
            axes.text(
                site + 1,
                -0.2,
                f"{clearance * 1e3:#.3g}",
                ha="center",
                va="top",
                fontsize=6.5,
                color=style.VERMILION,
            )
            last = site
    if chain.sites and not brief:
        middle = (chain.sites[0] + chain.sites[-1]) / 2 + 1
        axes.text(
            middle,
            -0.95,
            "clearance Δ (mm) of the contact sites",
            ha="center",
            va="top",
            fontsize=6.5,
            color=style.VERMILION,
        )
    elif not chain.sites:
        axes.text(n / 2, -0.2, "no contact sites", ha="center", va="top", fontsize=6.5, color=style.GREY)
    axes.set(xlim=(-0.035 * n, 1.035 * n), ylim=(-1.7, 2.3))
    axes.set_axis_off()


def with_prefix(value: float, unit: str) -> str:
    """A value with the prefix that keeps it readable: 20 kN/m, 2.5 g."""
    for factor, prefix in ((1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m")):
        if abs(value) >= factor:
            return f"{value / factor:.4g} {prefix}{unit}"
    return f"{value:.3g} {unit}"
