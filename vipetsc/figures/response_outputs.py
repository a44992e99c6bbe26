"""Motion of named masses and forces along a nonlinear frequency-response curve, as experiments draw them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.nfrc import NfrcCase
from vipetsc.figures import panels, style
from vipetsc.figures.nfrc import draw_linear, draw_special, has_places, parameter_of, response_page, responses_in
from vipetsc.figures.page import legend_entries
from vipetsc.figures.series import Series
from vipetsc.figures.style import NoPicture
from vipetsc.io.branch_kinds import RESPONSES, kind_of_file

# Lines of locations, which differ in greyscale print.
DASHES = ("-", style.DASHED, "-.", style.DOTTED)


def _all_have(branches: Sequence[xr.Dataset], name: str) -> bool:
    """Return whether each of ``branches`` has the variable ``name``."""
    return all(name in branch for branch in branches)


def response_outputs(paths: Sequence[Path]) -> Figure:
    """Draw amplitudes and phase of the named masses, and forces, over amplitude or frequency; a column a file.

    The motion of masses is drawn if all files have it, and so are forces. Raises NoPicture if
    some file has neither.
    """
    needs = "needs [output] points or forces = true in the case of nfrc"
    if any(kind_of_file(path) != RESPONSES for path in paths):
        raise NoPicture(needs)
    curves = responses_in(paths)
    if not (_all_have(curves, "lag") or _all_have(curves, "largest_force")):
        raise NoPicture(needs)

    rows: list[Callable[[Axes, xr.Dataset], None]] = []
    if _all_have(curves, "lag"):
        rows += [partial(_draw_amplitude, quantity=quantity) for quantity in panels.MOTION_UNITS]
        rows.append(_draw_lag)
    if _all_have(curves, "transmission"):
        rows.append(_draw_transmission)
    if _all_have(curves, "largest_force"):
        rows.append(_draw_forces)

    return response_page(curves, rows, height=1.45 * len(rows) + 0.3)


def _draw_amplitude(axes: Axes, curve: xr.Dataset, quantity: str) -> None:
    """Draw the largest value of a ``quantity`` at each location, and thin the amplitude of its first harmonic.

    A linear response is proportional to the drive: it is drawn in decibels, over the drive's amplitude.
    """
    unit = panels.MOTION_UNITS[quantity]
    if not has_places(curve):
        _draw_frequency_response(axes, curve, quantity)
        return
    for number, name in enumerate(curve["location"].values.astype(str)):
        _draw_states(axes, curve, curve[f"peak_{quantity}"].values[:, number], number, label=name)
        first = curve[f"first_{quantity}"].values[:, number]
        axes.plot(parameter_of(curve), first, color=style.band_colour(number + 1), lw=0.4, alpha=0.7)
    for number in range(curve.sizes["location"]):
        draw_linear(axes, curve, f"peak_{quantity}", number)
    axes.set_ylabel(f"{quantity} ({unit})")
    if quantity == "displacement":
        axes.plot([], [], lw=0.4, label="first harmonic", **style.CURVES["linear"])
        _legend(axes)


def _draw_frequency_response(axes: Axes, curve: xr.Dataset, quantity: str) -> None:
    """Draw the level of a ``quantity`` of linear motion over the drive at each location."""
    for number, name in enumerate(curve["location"].values.astype(str)):
        level = decibels(curve[f"first_{quantity}"].values[:, number] / curve["amplitude"].values)
        _draw_states(axes, curve, level, number, label=name)
    drive_unit = "m" if NfrcCase.of(curve).drive.end else "N"
    axes.set_ylabel(f"{quantity}\n(dB re 1 {panels.MOTION_UNITS[quantity]} per {drive_unit})")
    if quantity == "displacement":
        _legend(axes)


def _draw_transmission(axes: Axes, curve: xr.Dataset) -> None:
    """Draw the level of the transmission of each pair of locations, of rms velocities."""
    for number, name in enumerate(curve["pair"].values.astype(str)):
        _draw_states(axes, curve, decibels(curve["transmission"].values[:, number]), number, label=name)
    if "linear_transmission" in curve:
        of_linear = curve.assign(linear_transmission=decibels(curve["linear_transmission"]))
        for number in range(curve.sizes["pair"]):
            draw_linear(axes, of_linear, "transmission", number)
    axes.set_ylabel("transmission (dB)")
    _legend(axes)


def decibels(ratio: Any) -> Any:
    """Return the level of a ``ratio`` of amplitudes in dB."""
    with np.errstate(divide="ignore"):
        return 20 * np.log10(ratio)


def _legend(axes: Axes) -> None:
    """Draw a legend with one entry for each label."""
    entries = legend_entries([axes])
    axes.legend(entries.values(), entries.keys(), fontsize=6, loc="best")


def _draw_lag(axes: Axes, curve: xr.Dataset) -> None:
    """Draw the phase in degrees by which each location's fundamental is behind the drive."""
    for number in range(curve.sizes["location"]):
        # Files have lags from 0 to 360 degrees, between which a curve would jump across the panel.
        lag = panels.continuous_phase(curve["lag"].values[:, number], begin=-panels.ROUNDING)
        _draw_states(axes, curve, lag, number)
        # Grey lines have the same revolution as the curve at its beginning.
        if "linear_lag" in curve:
            linear = panels.continuous_phase(curve["linear_lag"].values[:, number], begin=-panels.ROUNDING)
            of_linear = curve.copy()
            of_linear["linear_lag"][:, number] = linear
            draw_linear(axes, of_linear, "lag", number)
    axes.set_ylabel("phase lag (degrees)")
    panels.mark_degrees(axes)


def _draw_forces(axes: Axes, curve: xr.Dataset) -> None:
    """Draw the largest force of each contact, and of the lattice on each wall."""
    number = 0
    for site, force in zip(curve["site"].values, curve["largest_force"].values.T, strict=True):
        _draw_states(axes, curve, force, number, label=f"contact of cell {site}")
        number += 1
    if "largest_wall_force" in curve:
        for wall, force in zip(curve["wall"].values.astype(str), curve["largest_wall_force"].values.T, strict=True):
            _draw_states(axes, curve, force, number, label=f"{wall} wall")
            number += 1
    axes.set_ylabel("largest force (N)")
    axes.legend(fontsize=6, loc="best")


def _draw_states(axes: Axes, curve: xr.Dataset, values: np.ndarray, number: int, label: str | None = None) -> None:
    """Draw ``values`` over the parameter in the look of curve ``number``; special points are marked."""
    look = {"color": style.band_colour(number + 1), "ls": DASHES[number % len(DASHES)]}
    Series(parameter_of(curve), values, look, label, unstable=curve["unstable"].values).draw(axes)
    draw_special(axes, curve, values)
