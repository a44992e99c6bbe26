"""A figure as numbers: positions, scales and labels of its axes, their curves, the values of a map's colours.

A page of a report lays these data over the picture, so that a reader can read values off and draw curves again.
"""

import re
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import Normalize, to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

# Pixels by which a curve may move when points of it are left out: half a pixel cannot be seen. The energies of a run
# then take 14 kB of a page; at a quarter of a pixel they take 25 kB, at a whole one 5 kB.
CLOSE = 0.5
FEW = 100  # points up to which a curve keeps all of them: a reader may want each
# Colours of a map that are listed with their values. A page interpolates the others, which are then off by at most 7 of
# the 255 levels (with twice as many stops by as much, with half as many by 8, with a quarter by 23).
STOPS = 33
SCALES = {"linear", "log"}  # of axes whose values a page can compute from the positions
MARKUP = re.compile(r"[${}]|\\[a-z]+ ?|\\[,;]")


class DrawnCurve(NamedTuple):
    """A line or scattered points of an axes: ``label`` and ``colour`` as matplotlib has them.

    ``points`` (n, 2) are in the units of the axes; ``joined``: whether a line joins them.
    """

    label: Any
    colour: Any
    joined: bool
    points: np.ndarray


def figure_data(figure: Figure, strip: float) -> list[dict[str, Any]]:
    """Describe every axes of a laid-out ``figure``, insets last; a ``strip`` in inches stands below its picture.

    An entry of the list has these keys:

    - ``box``: left, top, right and bottom as fractions of the picture with its strip, from its upper left corner;
    - ``title``;
    - ``x`` and ``y``: low, high, whether logarithmic, label;
    - ``curves``: label, colour, whether points are joined, x and y in four digits with None for a gap;
    - ``map``, of axes that show one: its label, ``colours`` (rrggbb one after another, lowest first), their ``values``.
    """
    height = figure.get_figheight()
    # The strip lengthens the picture at its lower edge: as fractions of it, heights are smaller by this factor.
    without_strip = height / (height + strip)

    outer = figure.get_axes()
    insets = [inset for axes in outer for inset in axes.child_axes]
    bars = {shape.norm: shape.colorbar.ax for axes in outer for shape in _maps(axes) if shape.colorbar}

    described = []
    for axes in [*outer, *insets]:
        if not _has_values(axes):
            continue
        # In fractions of the whole figure, also where the axes stand in a subfigure.
        box = axes.bbox.transformed(figure.transFigure.inverted())
        edges = [box.x0, (1 - box.y1) * without_strip, box.x1, (1 - box.y0) * without_strip]
        entry = {
            "box": [round(float(edge), 4) for edge in edges],
            "title": plain(axes.get_title("left") or axes.get_title("center")),
            "x": _axis(axes, "x"),
            "y": _axis(axes, "y"),
        }
        # Insets come last: a page shows the values of the uppermost axes at a place.
        described.append(entry | _content(axes, bars))
    return described


def plain(text: str) -> str:
    """Return a label without the marks of mathematical typesetting."""
    return MARKUP.sub("", text).replace("\n", " ")


def _has_values(axes: Axes) -> bool:
    """Return whether a page can lay values over ``axes``: visible, no colour bar, scales that it knows."""
    scales = {_scale(axes, "x"), _scale(axes, "y")}
    return bool(axes.axison) and axes.get_label() != "<colorbar>" and scales <= SCALES


def _scale(axes: Axes, name: str) -> str:
    return str(getattr(axes, f"get_{name}scale")())


def _axis(axes: Axes, name: str) -> dict[str, Any]:
    """Describe the axis ``name`` ("x" or "y"): limits, scale and label."""
    low, high = getattr(axes, f"get_{name}lim")()

    # Where axes share a scale, only one of them has the label, or the figure has it.
    shared = getattr(axes, f"get_shared_{name}_axes")().get_siblings(axes)
    labels = [getattr(other, f"get_{name}label")() for other in (axes, *shared)]
    figure_label = getattr(axes.figure, f"_sup{name}label")
    if figure_label:
        labels.append(figure_label.get_text())

    return {
        "low": float(f"{low:.8g}"),
        "high": float(f"{high:.8g}"),
        "log": _scale(axes, name) == "log",
        "label": plain(next(filter(None, labels), "")),
    }


def _maps(axes: Axes) -> list[Any]:
    """Return images and meshes in ``axes``, the lowest first."""
    return [*axes.images, *(shape for shape in axes.collections if isinstance(shape, QuadMesh))]


def _content(axes: Axes, bars: dict[Normalize, Axes]) -> dict[str, Any]:
    """Describe the curves of ``axes``, or its map; ``bars`` are the figure's colour bars by their scales."""
    maps = _maps(axes)
    if not maps:
        return {"curves": [_describe(axes, curve) for curve in _curves(axes) if len(curve.points)]}

    # The lowest image is the map: another one is a veil over it, which has no values of its own.
    lowest = maps[0]
    bar = bars.get(lowest.norm)
    label = ""
    if bar:
        label = plain(bar.get_ylabel() or bar.get_xlabel())
    stops = np.linspace(0, 1, STOPS)
    colours = "".join(to_hex(colour)[1:] for colour in lowest.cmap(stops))
    values = _rounded(lowest.norm.inverse(stops))
    return {"curves": [], "map": {"label": label, "colours": colours, "values": values}}


def _describe(axes: Axes, curve: DrawnCurve) -> dict[str, Any]:
    """Describe a curve by its label, colour and rounded points."""
    label = str(curve.label)
    x, y = curve.points.T
    return {
        "label": "" if label.startswith("_") else plain(label),  # matplotlib's own names begin so
        "colour": to_hex(curve.colour),
        "joined": curve.joined,
        "x": _rounded(x),
        "y": _rounded(y),
    }


def _curves(axes: Axes) -> list[DrawnCurve]:
    """Return lines and scattered points of ``axes``, thinned; error bars are named by their container."""
    bars = [shape for shape in axes.containers if isinstance(shape, ErrorbarContainer)]
    names = {bar[0]: bar.get_label() for bar in bars}
    caps = {cap for bar in bars for cap in bar[1]}

    curves = []
    for line in axes.lines:
        # Lines in the axes' own coordinates mark something, and have no values.
        in_data = all(line.get_transform().contains_branch_seperately(axes.transData))
        if in_data and line not in caps:
            joined = line.get_linestyle() != "None"
            label = names.get(line, line.get_label())
            curves.append(DrawnCurve(label, line.get_color(), joined, _thinned(axes, line.get_xydata(), joined)))

    for shape in axes.collections:
        if isinstance(shape, PathCollection) and len(shape.get_facecolor()):
            points = _thinned(axes, np.ma.filled(shape.get_offsets(), np.nan), joined=False)
            curves.append(DrawnCurve(shape.get_label(), shape.get_facecolor()[0], joined=False, points=points))
    return curves


def _thinned(axes: Axes, points: np.ndarray, joined: bool) -> np.ndarray:
    """Return those of ``points`` (n, 2) of a curve that a picture needs; a gap is one row of NaN."""
    points = np.asarray(points, dtype=float)
    with np.errstate(all="ignore"):
        pixels = axes.transData.transform(points)

    # Of a gap the first point stays, which follows a finite one.
    finite = np.isfinite(pixels).all(axis=1)
    keep = ~finite & np.append(False, finite[:-1])

    ends = np.flatnonzero(np.diff(finite, prepend=False, append=False))
    for first, end in zip(ends[::2], ends[1::2], strict=True):
        # A line joins the points that stay, and hides what is left out; scattered points have no such line.
        if joined and end - first > FEW:
            keep[first:end] = _needed(pixels[first:end])
        else:
            keep[first:end] = True
    thinned: np.ndarray = np.where(finite[:, None], points, np.nan)[keep]
    return thinned


def _needed(pixels: np.ndarray) -> np.ndarray:
    """Return which points (n,) of a curve in ``pixels`` (n, 2) are to stay so that it moves by ``CLOSE`` at most.

    D. H. Douglas and T. K. Peucker, Cartographica 10 (1973) 112-122.
    """
    keep = np.zeros(len(pixels), bool)
    keep[[0, -1]] = True

    # A list of the chords to be examined rather than a recursion, which of a noisy curve would be too deep for Python.
    chords = [(0, len(pixels) - 1)]
    while chords:
        first, last = chords.pop()
        chord = pixels[last] - pixels[first]
        between = pixels[first + 1 : last] - pixels[first]
        position = np.clip(between @ chord / max(chord @ chord, 1e-300), 0, 1)
        distance = np.hypot(*(between - position[:, None] * chord).T)
        if len(distance) and distance.max() > CLOSE:
            farthest = first + 1 + int(distance.argmax())
            keep[farthest] = True
            chords += [(first, farthest), (farthest, last)]
    return keep


def _rounded(values: np.ndarray) -> list[float | None]:
    """Return ``values`` in four digits, None for those that are not finite."""
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
