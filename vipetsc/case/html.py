"""Display of cases and results in a notebook: a table, and a drawing of the unit cell."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

import numpy as np

from vipetsc.case.contacts import describe_stops
from vipetsc.case.model import Model
from vipetsc.lattice import UnitCell, pass_bands
from vipetsc.lattice.chain import Pair

MOST_SHOWN = 8  # of a list
ROUNDING = 1e-6  # of a band's upper edge
# Of the drawing, in pixels.
COLUMN = 96.0
ROW = 62.0
RADIUS = 15.0
MARGIN = 28.0
COILS = 7
COIL_HEIGHT = 5.0
STYLE = {
    "spring": 'fill="none" stroke="#666" stroke-width="1.3"',
    "mass": 'fill="#cfe0f3" stroke="#27598c" stroke-width="1.5"',
    "next": 'fill="#fff" stroke="#27598c" stroke-dasharray="3 3"',
    "stop": 'fill="none" stroke="#c23b22" stroke-width="2.5"',
    "text": 'font-family="sans-serif" font-size="11" text-anchor="middle" fill="#222"',
}
Point = tuple[float, float]


def html_table(title: str, rows: Iterable[tuple[str, object]], drawing: str = "") -> str:
    """A table of names and values under a ``title``, without the rows that have no value; the ``drawing`` below."""
    lines = [
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(str(value))}</td></tr>'
        for name, value in rows
        if value not in (None, "")
    ]
    return f"<div><b>{escape(title)}</b><table>{''.join(lines)}</table>{drawing}</div>"


def case_html(name: str, model: Model, ends: str, drives: Sequence[str]) -> str:
    """The case ``name`` in a table: lattice, bands, contacts, ``drives`` in words; and its cell."""
    chain = model.chain
    cell = chain.cell
    bands = pass_bands(cell) if cell.springs else []
    # The edge at 0 is computed to rounding.
    edges = [f"{band.low if band.low > ROUNDING * band.high else 0:.5g} to {band.high:.5g}" for band in bands]
    masses = "1 mass" if cell.dofs == 1 else f"{cell.dofs} masses"
    laws = model.used_laws[:MOST_SHOWN]
    sites = [f"cell {site + 1}" for site in chain.sites]
    rows = [
        ("lattice", f"{chain.cells} cells of {masses}, {ends} ends"),
        ("pass bands in rad/s", first_few(edges)),
        ("contact", "; ".join(dict.fromkeys(map(str, laws))) if chain.sites else ""),
        ("sites", first_few(sites)),
        ("clearance", first_few(describe_stops(model.gaps, chain.clearances))),
        ("begins with", model.initial.describe() if model.initial else ""),
        ("drive", "; ".join(drives) if model.is_driven else "none"),
        ("end", f"{model.end:.5g} s, {model.samples} samples"),
    ]
    pair = chain.contact_pairs[0] if chain.sites else None
    return html_table(name, rows, cell_svg(cell, pair))


def first_few(items: Sequence[str]) -> str:
    """The first of ``items``, and how many there are if these are not all."""
    more = f", ... ({len(items)})" if len(items) > MOST_SHOWN else ""
    return ", ".join(items[:MOST_SHOWN]) + more


def cell_svg(cell: UnitCell, pair: Pair | None) -> str:
    """The unit cell as SVG: masses by number, springs, the stops of a ``pair``, masses of the next cell dashed."""
    places = _places(cell)
    shift = max((x for x, _ in places), default=0.0) + COLUMN
    parts = []
    for spring in cell.springs:
        begin = places[spring.start]
        end = _moved(places[spring.end], shift if spring.next_cell else 0.0)
        parts.append(_zigzag(begin, end))
    if pair is not None:
        host = places[pair.host] if pair.host >= 0 else _moved(places[pair.resonator], 0.0, ROW)
        parts.append(_stops(host, _moved(places[pair.resonator], shift if pair.next_cell else 0.0)))

    beyond = {spring.end for spring in cell.springs if spring.next_cell}
    beyond |= {pair.resonator} if pair and pair.next_cell else set()
    parts += [_mass(_moved(places[mass], shift), "", STYLE["next"]) for mass in sorted(beyond)]
    for number, place in enumerate(places):
        label = f"mass {number + 1}: {cell.masses[number]:.4g} kg"
        parts.append(_mass(place, str(number + 1), STYLE["mass"], label))

    width = shift + 2 * MARGIN
    top = min(y for _, y in places) - MARGIN
    height = MARGIN - top + (ROW if pair and pair.host < 0 else 0.0)
    box = f'viewBox="{-MARGIN:g} {top:g} {width:g} {height:g}" width="{width:g}" height="{height:g}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="unit cell" {box}>{"".join(parts)}</svg>'


def _places(cell: UnitCell) -> list[Point]:
    """Where each mass is drawn: those from one end of the cell to the other in a row, others above a neighbour."""
    joined: dict[int, list[int]] = {mass: [] for mass in range(cell.dofs)}
    for spring in cell.springs:
        if not spring.next_cell:
            joined[spring.start].append(spring.end)
            joined[spring.end].append(spring.start)

    grid = {mass: (column, 0) for column, mass in enumerate(_through(cell, joined))}
    waiting = list(grid)
    while len(grid) < cell.dofs:
        if not waiting:
            # A mass that no spring ties to the others stands in the row behind them.
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
    """The shortest way from a mass that the cell before is tied to, to one that is tied to the next cell."""
    entries = [(spring.end, spring.start) for spring in cell.springs if spring.next_cell]
    entry, last = entries[0] if entries else (0, 0)
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
    return place[0] + right, place[1] + down


def _mass(place: Point, number: str, style: str, label: str = "") -> str:
    x, y = place
    text = f'<text x="{x:g}" y="{y + 4:g}" {STYLE["text"]}>{number}</text>' if number else ""
    title = f"<title>{escape(label)}</title>" if label else ""
    return f'<g>{title}<circle cx="{x:g}" cy="{y:g}" r="{RADIUS:g}" {style}/>{text}</g>'


def _directions(begin: Point, end: Point) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first point, the way from it to the second, and the unit vector across that way."""
    start = np.array(begin)
    along = np.array(end) - start
    length = float(np.hypot(*along)) or 1.0
    across = np.array([-along[1], along[0]]) / length
    return start, along, across


def _zigzag(begin: Point, end: Point) -> str:
    """A spring between two masses."""
    start, along, across = _directions(begin, end)
    points = [start]
    for number in range(COILS + 1):
        side = 0.0 if number in (0, COILS) else COIL_HEIGHT * (-1) ** number
        points.append(start + along * (0.3 + 0.4 * number / COILS) + across * side)
    points.append(start + along)
    text = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{text}" {STYLE["spring"]}/>'


def _stops(host: Point, resonator: Point) -> str:
    """The clearance between the masses of a contact pair: two stops that face each other beside their spring."""
    start, along, across = _directions(host, resonator)
    # From inside the circles, which are drawn over them.
    beside = 0.7 * RADIUS
    parts = []
    for near, far in ((0.0, 0.45), (1.0, 0.55)):
        foot = start + along * near + across * beside
        tip = start + along * far + across * beside
        ends = [foot, tip, tip + across * 6, tip - across * 6]
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in ends)
        parts.append(f'<polyline points="{text}" {STYLE["stop"]}/>')
    return "".join(parts)
