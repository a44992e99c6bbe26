"""Nonlinear frequency-response curves: displacement, stability, folds, slow sweeps, and fractions of the energy.

A curve is a list of steady states under a harmonic drive, over its amplitude or frequency or another key of the case.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.nfrc import NfrcCase
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page
from vipetsc.figures.series import Series
from vipetsc.io.branch_kinds import CHOSEN, kind_names
from vipetsc.io.netcdf import open_netcdf
from vipetsc.wording import with_unit

# Label of each fraction of the energy, by its name in the file, and the name of its look.
ENERGIES = {
    "transmitted": ("T, transmitted", "transmitted"),
    "reflected": ("R, reflected", "reflected"),
    "upper": ("U, other harmonics", "upper"),
    "lost": ("L, dissipated in contacts", "dissipated"),
}
# Marks of special points, by the names of their kinds: label, marker, size.
SPECIAL = {
    "fold": ("fold", "o", 3.5),
    "neimark-sacker": ("Neimark-Sacker", "D", 3.0),
    "period-doubling": ("period doubling", "^", 3.8),
    "branch-point": ("branch point", "s", 3.2),
    CHOSEN: ("chosen value", "X", 3.8),
}
LEAST_FRACTION = 1e-3  # of the energy: a smaller one cannot be told from zero in the panel


def frequency_response(paths: Sequence[Path]) -> Figure:
    """Draw displacement over amplitude or frequency, and below it phases and fractions of the energy; a column a file.

    Phases are drawn if a force drives the lattice over its frequency, as in experiments, fractions if there are any.
    Raises OSError or ValueError for a file that holds no response.
    """
    branches = responses_in(paths, "share")
    if not all(map(has_places, branches)):
        raise style.NoPicture("needs contacts or nonlinear springs; the outputs show linear responses")
    if all("special" in branch.attrs for branch in branches):
        return response_page(branches, [_draw_plane], height=2.6)
    rows = [_draw_displacement]
    nfrc = NfrcCase.of(branches[0]).nfrc
    if nfrc.source == "force" and nfrc.over == "frequency":
        rows.append(_draw_phase)
    if any(map(has_fractions, branches)):
        rows.append(_draw_energies)

    return response_page(branches, rows, height=2.3 * len(rows))


def has_places(branch: xr.Dataset) -> bool:
    """Return whether a curve is that of a lattice with contacts or nonlinear springs; others have a linear response."""
    return bool(branch.sizes["site"]) or "largest_elongation" in branch


def draw_linear(axes: Axes, branch: xr.Dataset, name: str, number: int, scale: float = 1.0) -> None:
    """Draw ``scale`` times the quantity of that ``name`` in linear motion, which is grey and lies behind all else.

    ``number`` is that of its site, spring, location or pair. Files of curves by a wave do not have it.
    """
    values = branch.get(f"linear_{name}")
    if values is None:
        return
    curve = np.where(np.isfinite(values[:, number]), values[:, number], np.nan)
    low, high = axes.get_ylim()
    look = {"lw": 1.6, "alpha": 0.5, "zorder": 0.5, "label": "linear", **style.CURVES["linear"]}
    axes.plot(branch["linear"], scale * curve, **look)
    # A resonance without contacts may be far higher than all states: these are what the panel shows.
    axes.set_ylim(low, high)


def has_fractions(branch: xr.Dataset) -> bool:
    """Return whether a curve has fractions of the energy that can be seen.

    A state that takes up no energy, in a finite lattice without losses, has nothing to divide by, and contacts without
    loss have the rounding of zero.
    """
    return bool(np.nan_to_num(branch["share"].values).max() > LEAST_FRACTION)


def responses_in(paths: Sequence[Path], *needs: str) -> list[xr.Dataset]:
    """Return the frequency responses in the files ``paths``, read completely.

    Raises OSError for a file that cannot be opened, ValueError for one that holds no response, or lacks a variable of
    ``needs``.
    """
    curves = []
    for path in paths:
        with open_netcdf(path, "branch", (*needs, "unstable", "over")) as file:
            curves.append(file.load())
    return curves


def response_page(
    curves: Sequence[xr.Dataset], rows: Sequence[Callable[[Axes, xr.Dataset], None]], height: float
) -> Figure:
    """Return a page, ``height`` inches high, with a column for each of ``curves``, whose panels ``rows`` draw."""
    page = Page.of(len(rows), len(curves), height=height, sharex="col")
    for column, curve in zip(page.grid.T, curves, strict=True):
        for axes, draw in zip(column, rows, strict=True):
            draw(axes, curve)
        column[-1].set_xlabel(parameter_label(curve))
        if "parameter" in curve:
            column[-1].ticklabel_format(axis="x", scilimits=(-2, 4))
        column[0].set_title(str(curve.attrs["name"]))
    return page.lettered()


def parameter_label(branch: xr.Dataset) -> str:
    """Return what the horizontal axis shows, with its unit."""
    if branch.attrs["over"] == "frequency":
        return "frequency (rad/s)"
    case = NfrcCase.of(branch)
    if case.nfrc.varies_key:
        return with_unit(case.nfrc.over, str(branch["parameter"].attrs["units"]))
    if case.nfrc.source == "wave":
        return "amplitude of the wave / clearance"
    if case.drive.end:
        return "amplitude of the wall (m)"
    return "amplitude (N)"


def parameter_of(branch: xr.Dataset) -> np.ndarray:
    """Return the parameter (point,) that varies along a curve."""
    over = str(branch.attrs["over"])
    if over not in branch:
        # The values of a key of the case are a variable of their own.
        over = "parameter"
    values: np.ndarray = branch[over].values
    return values


def largest_motions(branch: xr.Dataset) -> np.ndarray:
    """Return the largest displacement (point, place) in m of each site; without sites of each nonlinear spring."""
    name = "largest" if branch.sizes["site"] else "largest_elongation"
    values: np.ndarray = branch[name].values
    return values


def lag_of(branch: xr.Dataset) -> np.ndarray:
    """Return the phase (point,) in degrees by which the first site, or else spring, is behind the drive.

    It is that of the fundamental Z_1 in w(t) = Re sum Z_k exp(i k Omega t), under a drive cos(Omega t). Along the curve
    it is continuous, and in the first state between -180 and 180 degrees; antiphase is 180.
    """
    name = "harmonics" if branch.sizes["site"] else "spring_harmonics"
    # The mean is harmonic 0.
    # Of subharmonics the drive's frequency is a multiple of the motion's.
    order = int(branch.attrs.get("drive_harmonic", 1))
    fundamental = branch[name].values[:, 0, order] + 1j * branch[f"{name}_imaginary"].values[:, 0, order]
    lag = -np.degrees(np.angle(fundamental))
    # Above -180 by more than rounding: of the two angles of antiphase it is 180.
    return panels.continuous_phase(lag, begin=panels.ROUNDING - 180)


def _draw_displacement(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the largest motion of the first site, and in thin lines that of the others, over the parameter.

    Stable states are a line, unstable ones dashes, undecided ones dashes with crosses; broad pale lines show where slow
    sweeps up and down went.
    """
    parameter = parameter_of(branch)
    unstable = branch["unstable"].values
    largest = largest_motions(branch)
    clearance = branch["clearance"].values
    # Springs and contacts that touch at rest have no clearance to compare with, and along a curve over another key the
    # clearances may change.
    if clearance.size and np.all(clearance > 0) and "parameter" not in branch:
        motion_label = "largest |w| / clearance"
        scale = 1 / clearance
    else:
        quantity = "largest |w|" if branch.sizes["site"] else "largest elongation"
        # Also of motions of a meter and more, as those of equations without units.
        unit, per_unit = ("mm", 1e3) if np.nanmax(largest) < 1 else ("m", 1.0)
        motion_label = f"{quantity} ({unit})"
        scale = np.full(largest.shape[1], per_unit)
    relative = scale * largest
    size = relative[:, 0]

    # One entry of the legend stands for all of them.
    others: str | None = "other springs"
    if branch.sizes["site"]:
        others = "other sites"
    for other in relative.T[1:]:
        axes.plot(parameter, other, color=style.GREY, lw=0.6, label=others)
        others = None

    # Sweeps lie beneath the curve, the one down narrower than the one up: all are seen where they coincide.
    for name, width in (("up", 6.0), ("down", 3.0)):
        points = branch[f"{name}_point"].values
        if points.size > 1:
            look = {"lw": width, "alpha": 0.35, "solid_capstyle": "butt", **style.CURVES[f"sweep {name}"]}
            axes.plot(parameter[points], size[points], label=f"sweep {name}", **look)

    thin: dict[str, Any] = {"lw": 0.9}
    if np.any(unstable > 0):
        thin["label"] = "unstable"
    label = "stable" if np.any(unstable == 0) else None
    Series(parameter, size, style.CURVES["response"], label, unstable=unstable, thin=thin).draw(axes)

    draw_special(axes, branch, size, labelled=True)
    name = "largest" if branch.sizes["site"] else "largest_elongation"
    draw_linear(axes, branch, name, 0, scale=scale[0])
    panels.widen(axes)
    axes.set_ylabel(motion_label)
    axes.legend(fontsize=6, loc="best")


def draw_special(axes: Axes, branch: xr.Dataset, values: np.ndarray, labelled: bool = False) -> None:
    """Mark the special points of a curve that shows ``values`` (point,), ``labelled`` for a legend if asked for."""
    parameter = parameter_of(branch)
    kinds = kind_names(branch)
    for kind, (label, marker, size) in SPECIAL.items():
        (places,) = np.nonzero(kinds == kind)
        if places.size:
            look = {"ms": size, "mfc": "white", "mec": style.VERMILION, "ls": "none", "marker": marker}
            if labelled:
                look["label"] = label
            axes.plot(parameter[places], values[places], **look)


def _draw_plane(axes: Axes, branch: xr.Dataset) -> None:
    """Draw a curve of special points over frequency and amplitude, with its cusps."""
    frequency = parameter_of(branch)
    amplitude = branch["amplitude"].values
    label = next(label for kind, (label, *_) in SPECIAL.items() if kind == branch.attrs["special"])
    axes.plot(frequency, amplitude, label=label, **style.CURVES["response"])
    names = np.array(branch["kind"].attrs["flag_meanings"].split())[branch["kind"].values]
    for kind, marker in (("cusp", "*"), ("extreme-amplitude", "v")):
        at = names == kind
        if at.any():
            axes.plot(
                frequency[at], amplitude[at], marker, mfc="white", mec=style.VERMILION, label=kind.replace("-", " ")
            )
    axes.set_ylabel("amplitude of the drive")
    axes.legend(fontsize=6, loc="best")


def _draw_phase(axes: Axes, branch: xr.Dataset) -> None:
    """Draw the phase of the first site's fundamental behind the drive."""
    lag = Series(
        parameter_of(branch),
        lag_of(branch),
        style.CURVES["response"],
        unstable=branch["unstable"].values,
        thin={"lw": 0.6},
    )
    lag.draw(axes)
    axes.set_ylabel("phase lag (degrees)")
    panels.mark_degrees(axes)


def _draw_energies(axes: Axes, branch: xr.Dataset) -> None:
    """Draw T, R, U and L over the parameter."""
    parameter = parameter_of(branch)
    unstable = branch["unstable"].values
    for i, name in enumerate(branch["way"].values.astype(str)):
        label, look = ENERGIES[name]
        fraction = branch["share"].values[:, i]
        # No wave leaves a finite lattice: of its fractions only the losses are finite.
        if np.isfinite(fraction).any():
            line = {"lw": 1.4, **style.CURVES[look]}
            Series(parameter, fraction, line, label, unstable=unstable, thin={"ls": line["ls"]}).draw(axes)

    axes.set(ylabel="fraction of the energy")
    # Losses alone may be small; what is transmitted and reflected adds up to nearly 1.
    if np.nanmax(branch["share"].values) > 0.5:
        axes.set_ylim(-0.02, 1.04)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=6, loc="best", handlelength=style.DASHES_SEEN)
