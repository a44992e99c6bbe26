"""All frequency-response curves of a folder on common axes: the keys by which they differ are the legend."""

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.keys import unit_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.sweep import coordinate
from vipetsc.figures import panels, style
from vipetsc.figures.nfrc import (
    draw_special,
    has_places,
    lag_of,
    largest_motions,
    parameter_label,
    parameter_of,
    responses_in,
)
from vipetsc.figures.page import Page
from vipetsc.figures.series import UNDECIDED, Series
from vipetsc.figures.style import NoPicture
from vipetsc.figures.swept_axes import SweptKey
from vipetsc.io.branch_kinds import RESPONSES, kind_of_file

MOST_LOCATIONS = 4  # that have a row each: with those of the site and the phase they fill the height of a page
MOST_CURVES = 24  # that the legend names, which is then three inches high


def response_family(paths: Sequence[Path]) -> Figure:
    """Draw the curves in ``paths`` over amplitude or frequency on common axes.

    Rows are the largest relative displacement of the first site, the largest displacement of each named mass that all
    curves have, and the phase of the first site's fundamental under a force over its frequency.
    """
    needs = "needs several curves of nfrc"
    if len(paths) < 2 or any(kind_of_file(path) != RESPONSES for path in paths):
        raise NoPicture(needs)
    # Curves of special points over two parameters have a picture of their own.
    curves = [curve for curve in responses_in(paths) if "special" not in curve.attrs]
    if len(curves) < 2:
        raise NoPicture(needs)
    if len({str(curve.attrs["over"]) for curve in curves}) > 1:
        raise NoPicture("needs curves over the same parameter")

    quantities = _quantities(curves)
    if not quantities:
        raise NoPicture("needs named masses that all curves have, or contacts or nonlinear springs in all")
    labels, rows = zip(*quantities.items(), strict=True)
    has_phase = lag_of in rows
    locations = _common_locations(curves)

    names = legend_of(curves)
    has_undecided = any(np.any(curve["unstable"].values < 0) for curve in curves)
    lines = min(len(curves), MOST_CURVES) + has_undecided
    height = 1.7 * len(rows) + 0.3
    page = Page.of(len(rows), width=1.3 * style.COLUMN, height=height, legend=lines, sharex=True)
    colours = _colours(len(curves))
    for axes, values_of, label in zip(page.panels, rows, labels, strict=True):
        for curve, name, colour in zip(curves, names, colours, strict=True):
            _draw_curve(axes, curve, values_of(curve), name, colour)
        axes.set_ylabel(label)
    if has_phase:
        panels.mark_degrees(page.panels[-1])
    page.panels[-1].set_xlabel(parameter_label(curves[0]))
    handles, texts = page.panels[0].get_legend_handles_labels()
    # The curves first, and crosses for all of them behind.
    order = sorted(range(len(texts)), key=lambda number: texts[number] == UNDECIDED)
    shown = [*order[: len(curves)][:MOST_CURVES], *order[len(curves) :]]
    page.write_legend([handles[number] for number in shown], [texts[number] for number in shown])
    if len(curves) > MOST_CURVES:
        style.add_note(page.figure, f"the legend names the first {MOST_CURVES} of {len(curves)} curves")
    if len(locations) > MOST_LOCATIONS:
        style.add_note(page.figure, f"the first {MOST_LOCATIONS} of {len(locations)} named masses")
    return page.lettered()


def _quantities(curves: Sequence[xr.Dataset]) -> dict[str, Callable[[xr.Dataset], np.ndarray]]:
    """Return what the rows of the page show of each of ``curves``, by the labels of their axes."""
    quantities: dict[str, Callable[[xr.Dataset], np.ndarray]] = {}
    with_places = all(map(has_places, curves))
    if with_places:
        quantities["largest |w| (m)" if curves[0].sizes["site"] else "largest elongation\n(m)"] = _relative
    for name in _common_locations(curves)[:MOST_LOCATIONS]:
        quantities[f"displacement\nof {name} (m)"] = partial(_displacement, name=name)
    nfrc = NfrcCase.of(curves[0]).nfrc
    if with_places and nfrc.source == "force" and nfrc.over == "frequency":
        quantities["phase lag (degrees)"] = lag_of
    return quantities


def legend_of(curves: Sequence[xr.Dataset]) -> list[str]:
    """Return a text for each of ``curves``: the keys that differ among them, with values and units."""
    keys = [_keys_of(curve) for curve in curves]
    parts: list[list[str]] = [[] for _ in curves]
    # In the order of the first curve. A key that has one value in all curves tells none from another.
    for path in dict.fromkeys(path for curve_keys in keys for path in curve_keys):
        values = [curve_keys.get(path, ("", ""))[0] for curve_keys in keys]
        if len({repr(value) for value in values}) == 1:
            continue
        unit = next(curve_keys[path][1] for curve_keys in keys if path in curve_keys)
        texts = SweptKey(path, unit, coordinate(values)).texts
        for part, text in zip(parts, texts, strict=True):
            part.append(text)
    texts = []
    names = [str(curve.attrs.get("name", "")) for curve in curves]
    for part, curve in zip(parts, curves, strict=True):
        # A curve that was found from another one has the keys of that: the rest of its name tells them apart.
        name = str(curve.attrs.get("name", ""))
        origin = min((other for other in names if name.startswith(f"{other}-")), key=len, default=name)
        has_others = any(other.startswith(f"{name}-") for other in names)
        named = [*part, name[len(origin) + 1 :].replace("-", " ")]
        if origin == name and not part:
            named = ["main curve" if has_others else name]
        texts.append(", ".join(filter(None, named)))
    return texts


def _keys_of(curve: xr.Dataset) -> dict[str, tuple[Any, str]]:
    """Return the keys by which a curve may differ from others: value and unit by the key's path."""
    case = NfrcCase.of(curve)
    table = case.model_dump(by_alias=True, exclude_none=True)
    # The keys that [nfrc.family] varies, as JSON.
    family = json.loads(curve.attrs.get("family", "{}"))
    keys = {path: (value, unit_of(path, table)) for path, value in family.items()}
    # An amplitude or frequency that does not vary is that of all points.
    over = curve.attrs["over"]
    if over != "amplitude":
        unit = "clearances" if case.nfrc.source == "wave" else unit_of("drive.amplitude", table)
        keys["amplitude"] = (float(curve["amplitude"].values[0]), unit)
    if over != "frequency":
        keys["frequency"] = (float(curve["frequency"].values[0]), "rad/s")
    # It is NaN where each site has its own.
    if np.isfinite(curve.attrs["restitution"]):
        keys["restitution"] = (float(curve.attrs["restitution"]), "")
    return keys


def _common_locations(curves: Sequence[xr.Dataset]) -> list[str]:
    """Return the named masses that all ``curves`` have."""
    if any("location" not in curve for curve in curves):
        return []
    first = curves[0]["location"].values.astype(str)
    return [name for name in first if all(name in curve["location"].values.astype(str) for curve in curves)]


def _relative(curve: xr.Dataset) -> np.ndarray:
    """Return the largest relative displacement (point,) in m of the first site."""
    return largest_motions(curve)[:, 0]


def _displacement(curve: xr.Dataset, name: str) -> np.ndarray:
    """Return the largest displacement (point,) in m of the mass of that ``name``."""
    number = curve["location"].values.astype(str).tolist().index(name)
    values: np.ndarray = curve["peak_displacement"].values[:, number]
    return values


def _draw_curve(axes: Axes, curve: xr.Dataset, values: np.ndarray, name: str, colour: Any) -> None:
    """Draw ``values`` (point,) of a curve, with that ``name`` in the legend; special points are marked."""
    Series(parameter_of(curve), values, {"color": colour}, name, unstable=curve["unstable"].values).draw(axes)
    draw_special(axes, curve, values)


def _colours(count: int) -> list[Any]:
    """Return a colour for each of ``count`` curves: those of bands if these are enough, else a scale."""
    if count <= len(style.BAND_COLOURS):
        return [style.band_colour(number) for number in range(1, count + 1)]
    return [colormaps["viridis"](place) for place in np.linspace(0, 0.9, count)]
