"""Motion of named masses and forces along a nonlinear frequency-response curve, as experiments draw them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import panels, style
from vipetsc.figures.nfrc import draw_special, parameter_of, response_page, responses_in
from vipetsc.figures.stability import StabilityLook, draw_states
from vipetsc.figures.style import NoPicture
from vipetsc.io.branch_kinds import RESPONSES, kind_of_file

# Labels of the rows of the page by the quantities that they show.
AMPLITUDES = {"displacement": "displacement (m)", "velocity": "velocity (m/s)", "acceleration": "acceleration (m/s²)"}
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
        rows += [partial(_draw_amplitude, quantity=quantity) for quantity in AMPLITUDES]
        rows.append(_draw_lag)
    if _all_have(curves, "largest_force"):
        rows.append(_draw_forces)

    return response_page(curves, rows, height=1.45 * len(rows) + 0.3)


def _draw_amplitude(axes: Axes, curve: xr.Dataset, quantity: str) -> None:
    """Draw the largest value of a ``quantity`` at each location, and thin the amplitude of its first harmonic."""
    for number, name in enumerate(curve["location"].values.astype(str)):
        _draw_states(axes, curve, curve[f"peak_{quantity}"].values[:, number], number, label=name)
        first = curve[f"first_{quantity}"].values[:, number]
        axes.plot(parameter_of(curve), first, color=style.band_colour(number + 1), lw=0.4, alpha=0.7)
    axes.set_ylabel(AMPLITUDES[quantity])
    if quantity == "displacement":
        axes.plot([], [], color=style.GREY, lw=0.4, label="first harmonic")
        axes.legend(fontsize=6, loc="best")


def _draw_lag(axes: Axes, curve: xr.Dataset) -> None:
    """Draw the phase in degrees by which each location's fundamental is behind the drive."""
    for number in range(curve.sizes["location"]):
        # Files have lags from 0 to 360 degrees, between which a curve would jump across the panel.
        lag = panels.continuous_phase(curve["lag"].values[:, number], begin=-panels.ROUNDING)
        _draw_states(axes, curve, lag, number)
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
    look = StabilityLook(style.band_colour(number + 1), broad_dashes=DASHES[number % len(DASHES)])
    draw_states(axes, parameter_of(curve), values, curve["unstable"].values, look, label)
    draw_special(axes, curve, values)
