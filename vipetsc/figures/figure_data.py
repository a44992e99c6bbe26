"""What a figure shows, as numbers: its axes' places, scales and labels, their curves, the values of a map's colours.

A page lays this over the picture, so that values can be read off and curves drawn again, larger or without some.
"""

import re
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

CLOSE = 0.5  # pixels that a curve may move for the sake of fewer points
FEW = 100  # points of a curve, of which none is left out
STOPS = 33  # colours of a map whose values are told; those between lie on lines
MARKUP = re.compile(r"[${}]|\\[a-z]+ ?|\\[,;]")


def drawn(figure: Figure, strip: float) -> list[dict[str, Any]]:
    """Every axes of a laid-out ``figure`` under whose picture a ``strip`` (in) stands, insets last.

    ``box``: left, top, right and bottom as shares of the picture; ``title``; ``x`` and ``y``: low, high, whether
    logarithmic, label; ``curves``: label, colour, whether points are joined, x and y in four digits, None for a gap;
    ``map`` of axes with one: its label, ``colours`` (rrggbb one after another, lowest first), and their ``values``.
    """
    _, height = figure.get_size_inches()
    share = height / (height + strip)
    panels = []
    outer = figure.get_axes()
    bars = {shape.norm: shape.colorbar.ax for axes in outer for shape in _maps(axes) if shape.colorbar}
    for axes in [*outer, *(inset for around in outer for inset in around.child_axes)]:
        if not axes.axison or axes.get_label() == "<colorbar>" or not {_scale(axes, way) for way in "xy"} <= SCALES:
            continue
        box = axes.bbox.transformed(figure.transFigure.inverted())  # that of a subfigure's axes as well
        edges = [box.x0, (1 - box.y1) * share, box.x1, (1 - box.y0) * share]
        about = {"box": [round(float(edge), 4) for edge in edges], "title": plain(axes.get_title("left"))}
        panels.append(about | {"x": _axis(axes, "x"), "y": _axis(axes, "y")} | _shown(axes, bars))
    return panels


SCALES = {"linear", "log"}


def plain(text: str) -> str:
    """A label without the marks of mathematical typesetting."""
    return MARKUP.sub("", text).replace("\n", " ")


def _scale(axes: Axes, way: str) -> str:
    return str(getattr(axes, f"get_{way}scale")())


def _axis(axes: Axes, way: str) -> dict[str, Any]:
    """Limits, scale and label; of axes that share a scale the outer one has the label."""
    shared = getattr(axes, f"get_shared_{way}_axes")().get_siblings(axes)
    labels = [getattr(other, f"get_{way}label")() for other in (axes, *shared)]
    low, high = (float(f"{value:.8g}") for value in getattr(axes, f"get_{way}lim")())
    if whole := getattr(axes.figure, f"_sup{way}label"):
        labels.append(whole.get_text())
    return {"low": low, "high": high, "log": _scale(axes, way) == "log", "label": plain(next(filter(None, labels), ""))}


def _maps(axes: Axes) -> list[Any]:
    """Images and meshes in ``axes``, the lowest first."""
    return [*axes.images, *(shape for shape in axes.collections if isinstance(shape, QuadMesh))]


def _shown(axes: Axes, bars: dict[Any, Axes]) -> dict[str, Any]:
    """The curves of ``axes``, or what its map's colours stand for, with the label of the one of ``bars`` for them."""
    if not (maps := _maps(axes)):
        return {"curves": _curves(axes)}
    norm, shares, bar = maps[0].norm, np.linspace(0, 1, STOPS), bars.get(maps[0].norm)
    label = plain(bar.get_ylabel() or bar.get_xlabel()) if bar else ""
    colours = "".join(to_hex(colour)[1:] for colour in maps[0].cmap(shares))
    return {"curves": [], "map": {"label": label, "colours": colours, "values": _rounded(norm.inverse(shares))}}


def _curves(axes: Axes) -> list[dict[str, Any]]:
    """Lines and scattered points in the data's coordinates; error bars are named by their container."""
    bars = [shape for shape in axes.containers if isinstance(shape, ErrorbarContainer)]
    names, caps = {bar[0]: bar.get_label() for bar in bars}, {cap for bar in bars for cap in bar[1]}
    shapes = [
        (names.get(line, line.get_label()), line.get_color(), line.get_linestyle() != "None", line.get_xydata())
        for line in axes.lines
        if line not in caps and all(line.get_transform().contains_branch_seperately(axes.transData))
    ]
    shapes += [
        (points.get_label(), points.get_facecolor()[0], False, np.ma.filled(points.get_offsets(), np.nan))
        for points in axes.collections
        if isinstance(points, PathCollection) and len(points.get_facecolor())
    ]
    curves = []
    for label, colour, joined, points in shapes:
        x, y = (_rounded(column) for column in _thinned(axes, np.asarray(points, dtype=float), joined).T)
        if x:
            about = {"label": "" if str(label).startswith("_") else plain(str(label)), "colour": to_hex(colour)}
            curves.append(about | {"joined": joined, "x": x, "y": y})
    return curves


def _thinned(axes: Axes, points: np.ndarray, joined: bool) -> np.ndarray:
    """``points`` (n, 2), of long curves those that a picture needs; gaps are one row of NaN."""
    with np.errstate(all="ignore"):
        place = axes.transData.transform(points)
    finite = np.isfinite(place).all(axis=1)
    keep = ~finite & np.append(False, finite[:-1])
    ends = np.flatnonzero(np.diff(finite, prepend=False, append=False))
    for first, end in zip(ends[::2], ends[1::2], strict=True):
        keep[first:end] = _needed(place[first:end]) if joined and end - first > FEW else True
    thinned: np.ndarray = np.where(finite[:, None], points, np.nan)[keep]
    return thinned


def _needed(place: np.ndarray) -> np.ndarray:
    """Which points (n) of a curve in pixels (n, 2) are to stay so that it moves by CLOSE at most.

    D. H. Douglas and T. K. Peucker, Cartographica 10 (1973) 112-122.
    """
    keep, left = np.zeros(len(place), bool), [(0, len(place) - 1)]
    keep[[0, -1]] = True
    while left:
        first, last = left.pop()
        way, along = place[last] - place[first], place[first + 1 : last] - place[first]
        share = np.clip(along @ way / max(way @ way, 1e-300), 0, 1)
        distance = np.hypot(*(along - share[:, None] * way).T)
        if len(distance) and distance.max() > CLOSE:
            middle = first + 1 + int(distance.argmax())
            keep[middle] = True
            left += [(first, middle), (middle, last)]
    return keep


def _rounded(values: np.ndarray) -> list[float | None]:
    return [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
