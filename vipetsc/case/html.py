"""Display of cases and results in a notebook: a table, and a drawing of the unit cell."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from vipetsc.case.contacts import describe_stops
from vipetsc.case.model import Model
from vipetsc.lattice import UnitCell, wave_bands
from vipetsc.lattice.cell import GROUND
from vipetsc.lattice.sites import Pair
from vipetsc.wording import MOST_SHOWN, counted, shortened

# Fraction of a band's upper edge that counts as zero. A frequency is the root of an eigenvalue, which has a rounding
# error of 1e-16 of the largest one, so that an edge at zero is computed as 1e-8 of the largest frequency.
ROUNDING = 1e-6
# Lengths of the drawing in pixels, and the number of turns of a spring.
COLUMN = 96.0  # between neighbouring masses of a row
ROW = 62.0  # between rows
RADIUS = 15.0  # of a mass
MARGIN = 28.0  # around the centres of the outermost masses
COILS = 7
MOST_DRAWN = 24  # springs of a cell: a cell from matrices has more
COIL_HEIGHT = 5.0  # from the line between the masses to a turn
STYLE = {
    "spring": 'fill="none" stroke="#666" stroke-width="1.3"',
    "mass": 'fill="#cfe0f3" stroke="#27598c" stroke-width="1.5"',
    "next": 'fill="#fff" stroke="#27598c" stroke-dasharray="3 3"',
    "stop": 'fill="none" stroke="#c23b22" stroke-width="2.5"',
    "text": 'font-family="sans-serif" font-size="11" text-anchor="middle" fill="#222"',
}
Point = tuple[float, float]


def html_table(title: str, rows: Iterable[tuple[str, object]], drawing: str = "") -> str:
    """Return a table of names and values under a ``title``, without rows that have no value; the ``drawing`` below."""
    lines = [
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows
        if value not in (None, "")
    ]
    return f"<div><b>{escape(title)}</b><table>{''.join(lines)}</table>{drawing}</div>"


def case_html(name: str, model: Model, ends: str, drives: Sequence[str]) -> str:
    """Return case ``name`` as HTML: a table of lattice, bands, contacts and ``drives`` (in words), its cell drawn."""
    chain = model.chain
    cell = chain.cell
    rows = [
        ("lattice", f"{counted(chain.cells, 'cell')} of {counted(cell.dofs, 'mass')}, {ends} ends"),
        ("pass bands in rad/s", shortened(_band_edges(cell))),
    ]

    pair = None
    if chain.sites:
        pair = chain.sites[0].pair
        laws = chain.sites.laws[:MOST_SHOWN]
        rows += [
            ("contact", "; ".join(dict.fromkeys(map(str, laws)))),
            ("sites", shortened([f"cell {site + 1}" for site in chain.sites.cells])),
            ("clearance", shortened(describe_stops(chain.sites.gaps))),
        ]
    if model.initial:
        rows.append(("begins with", model.initial.describe()))
    rows += [("drive", "; ".join(drives) or "none"), ("end", f"{model.end:.5g} s, {model.samples} samples")]
    drawing = ""
    if len(cell.springs) <= MOST_DRAWN:
        drawing = cell_svg(cell, pair)
    return html_table(name, rows, drawing)


def _band_edges(cell: UnitCell) -> list[str]:
    """Return the edges of the pass bands of a ``cell`` in rad/s, as text; none where contacts alone join the cells."""
    edges = []
    for band in wave_bands(cell):
        low = band.low
        # An edge at 0 has a rounding error.
        if low <= ROUNDING * band.high:
            low = 0.0
        edges.append(f"{low:.5g} to {band.high:.5g}")
    return edges


def cell_svg(cell: UnitCell, pair: Pair | None) -> str:
    """Return unit cell as SVG: masses by number, springs, the stops of a ``pair``, masses of the next cell dashed."""
    places = _places(cell)
    shift = max((x for x, _ in places), default=0.0) + COLUMN
    next_places = [_moved(place, shift) for place in places]
    parts = []
    beyond = set()  # masses of the next cell that are drawn
    grounds = []  # places on the ground, below the masses that springs tie to it
    for spring in cell.springs:
        end = places[spring.end]
        if spring.offset:
            end = next_places[spring.end]
            beyond.add(spring.end)
        if spring.start == GROUND:
            grounds.append(_moved(end, 0.0, ROW))
            parts.append(_zigzag(grounds[-1], end))
        else:
            parts.append(_zigzag(places[spring.start], end))
    parts += [_ground(place) for place in grounds]

    top = min(y for _, y in places) - MARGIN
    height = max([y for _, y in grounds], default=0.0) + MARGIN - top
    if pair is not None:
        resonator = places[pair.resonator]
        if pair.offset:
            resonator = next_places[pair.resonator]
            beyond.add(pair.resonator)
        host = places[pair.host]
        if pair.host < 0:
            # The ground, below the mass that it stops.
            host = _moved(places[pair.resonator], 0.0, ROW)
            height = max(height, host[1] + MARGIN - top)
        parts.append(_stops(host, resonator))

    parts += [_mass(next_places[mass], "", STYLE["next"]) for mass in sorted(beyond)]
    for number, place in enumerate(places):
        label = f"mass {number + 1}: {cell.masses[number]:.4g} kg"
        parts.append(_mass(place, str(number + 1), STYLE["mass"], label))

    # A spring or a contact may lead to a mass farther on in the next cell.
    right = max((next_places[mass][0] for mass in beyond), default=shift)
    width = right + 2 * MARGIN
    box = f'viewBox="{-MARGIN:g} {top:g} {width:g} {height:g}" width="{width:g}" height="{height:g}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="unit cell" {box}>{"".join(parts)}</svg>'


def _places(cell: UnitCell) -> list[Point]:
    """Return place of each mass: masses on the way through the cell form a row, others are above one that they join."""
    joined: dict[int, list[int]] = {mass: [] for mass in range(cell.dofs)}
    for spring in cell.springs:
        if not spring.offset and spring.start != GROUND:
            joined[spring.start].append(spring.end)
            joined[spring.end].append(spring.start)

    grid = {mass: (column, 0) for column, mass in enumerate(_through(cell, joined))}
    waiting = list(grid)
    while len(grid) < cell.dofs:
        if not waiting:
            # A mass without springs to the others is at the end of the row.
            waiting = [min(joined.keys() - grid.keys())]
            grid[waiting[0]] = (1 + max(column for column, _ in grid.values()), 0)
        at = waiting.pop(0)
        for mass in sorted({*joined[at]} - grid.keys()):
            column, row = grid[at]
            while (column, row + 1) in grid.values():
                column += 1
            grid[mass] = (column, row + 1)
            waiting.append(mass)
    return [(COLUMN * grid[mass][0], -ROW * grid[mass][1]) for mass in range(cell.dofs)]


def _through(cell: UnitCell, joined: Mapping[int, Sequence[int]]) -> list[int]:
    """Return the shortest path from a mass that the cell before is tied to, to one that is tied to the next cell."""
    entry = last = 0
    for spring in cell.springs:
        if spring.offset:
            entry = spring.end
            last = spring.start
            break

    # Breadth first: the list of paths grows while it is read, shorter paths before longer ones.
    paths = [[entry]]
    seen = {entry}
    for path in paths:
        if path[-1] == last:
            return path
        for mass in joined[path[-1]]:
            if mass not in seen:
                seen.add(mass)
                paths.append([*path, mass])
    return [entry]


def _moved(place: Point, right: float, down: float = 0.0) -> Point:
    """Return the ``place`` moved to the ``right`` and ``down``."""
    return place[0] + right, place[1] + down


def _mass(place: Point, number: str, style: str, label: str = "") -> str:
    """Return a mass as a circle with its ``number``; a ``label`` is shown under the mouse."""
    x, y = place
    parts = [f'<circle cx="{x:g}" cy="{y:g}" r="{RADIUS:g}" {style}/>']
    if label:
        parts.insert(0, f"<title>{escape(label)}</title>")
    if number:
        parts.append(f'<text x="{x:g}" y="{y + 4:g}" {STYLE["text"]}>{number}</text>')
    return f"<g>{''.join(parts)}</g>"


def _directions(begin: Point, end: Point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first point, the vector from it to the second, and the unit vector normal to that."""
    start = np.array(begin)
    along = np.array(end) - start
    length = float(np.hypot(*along)) or 1.0
    across = np.array([-along[1], along[0]]) / length
    return start, along, across


def _zigzag(begin: Point, end: Point) -> str:
    """Return a spring between two masses."""
    start, along, across = _directions(begin, end)
    points = [start]
    for number in range(COILS + 1):
        side = COIL_HEIGHT * (-1) ** number
        # The zigzag begins and ends on the line between the masses.
        if number in (0, COILS):
            side = 0.0
        points.append(start + along * (0.3 + 0.4 * number / COILS) + across * side)
    points.append(start + along)
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{text}" {STYLE["spring"]}/>'


def _ground(place: Point) -> str:
    """Return the ground at the foot of a spring."""
    x, y = place
    points = f"{x - RADIUS:.1f},{y:.1f} {x + RADIUS:.1f},{y:.1f}"
    return f'<polyline points="{points}" {STYLE["stop"]}/>'


def _stops(host: Point, resonator: Point) -> str:
    """Return clearance between the masses of a contact pair: two stops that face each other, next to their spring."""
    start, along, across = _directions(host, resonator)
    # The stops begin inside the circles, which are drawn over them.
    aside = 0.7 * RADIUS
    parts = []
    for near, far in ((0.0, 0.45), (1.0, 0.55)):
        foot = start + along * near + across * aside
        tip = start + along * far + across * aside
        ends = [foot, tip, tip + across * 6, tip - across * 6]
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in ends)
        parts.append(f'<polyline points="{text}" {STYLE["stop"]}/>')
    return "".join(parts)
