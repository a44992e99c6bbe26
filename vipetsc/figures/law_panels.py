"""The scattering law of one site: energies over z, energies by band and direction, and the onset enlarged."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from vipetsc.figures import style
from vipetsc.figures.page import Page
from vipetsc.figures.series import Series

LABELS = {
    "transmitted": "T, transmitted",
    "reflected": "R, reflected",
    "upper": "U, upper bands",
    "dissipated": "L, dissipated",
    "dashpots": "D, dashpots",
}
FLOOR = 1e-5  # smallest fraction of the incident energy that a logarithmic axis shows
MARKS: dict[str, dict[str, Any]] = {
    "forward": {},
    "backward": {"marker": "o", "ms": 3, "mfc": "white", "mew": 0.7, "markevery": 0.1},
}
LABELS_TO = 20  # largest z of an axis that has labels at 2 and 5 too: on a longer one they would touch


def law(data: xr.Dataset) -> Figure:
    """Draw over z: T, R, U, L (and D); what leaves by band and direction; T, U and U/(1-T) from the onset on.

    z is the largest relative displacement that the wave would cause at the site without contact, over the clearance:
    contact begins at z = 1. A dotted line marks z*: among the points at which U/(1-T) is nearly largest, it is the one
    with the largest T.
    """
    z = data["z"].values
    page = Page.of(columns=3, height=2.9)
    all_energies, by_band, onset = page.panels
    for name in LABELS:
        if name in data:
            _draw_energy(all_energies, z, data, name)
    sums_to_one = "T + R + U + L + other bands = 1"
    if "dashpots" in data:
        sums_to_one = "T + R + U + L + D + rest = 1"
    _draw_bands(by_band, data)
    for name in ("transmitted", "upper"):
        # Over z - 1, since over z the onset is a vertical line.
        _draw_energy(onset, z - 1, data, name)
    efficiency = data["efficiency"].values
    positive = np.where(efficiency > 0, efficiency, np.nan)
    onset.plot(z - 1, positive, color=style.BLACK, lw=1.2, ls=style.DASHED, label="U/(1 - T)")

    for axes in (all_energies, by_band):
        axes.set(xscale="log", xlabel="z = linear displacement / clearance", xlim=(0.9, z[-1]))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if z[-1] > LABELS_TO else (1.0, 2.0, 5.0)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    all_energies.set(ylim=(0, 1.02), ylabel="fraction of the incident energy")
    by_band.set(yscale="log", ylim=(FLOOR / 10, 1.5))
    onset.set(xscale="log", xlabel="z - 1", xlim=(max((z[1] - 1) / 2, 1e-4), 3), ylim=(0, 1.02))

    all_energies.set_title(sums_to_one, fontsize=8)
    by_band.set_title("by band; circles: backward", fontsize=8)
    matched = float(data.attrs["matched_z"])
    if np.isfinite(matched):
        for axes, at in ((all_energies, matched), (by_band, matched), (onset, matched - 1)):
            axes.axvline(at, color=style.GREY, lw=0.8, ls=style.DOTTED)
        transmitted = float(data.attrs["matched_transmitted"])
        onset.set_title(f"z* = {matched:.3g}, T = {transmitted:.3g}", fontsize=8)

    all_energies.legend(fontsize=6, loc="center right", handlelength=style.DASHES_SEEN)
    by_band.legend(fontsize=6, loc="lower left", ncols=2, handlelength=style.DASHES_SEEN)
    onset.legend(fontsize=6, loc="center left", bbox_to_anchor=(0.0, 0.45), handlelength=style.DASHES_SEEN)
    return page.lettered()


def _draw_energy(axes: Axes, x: np.ndarray, data: xr.Dataset, name: str) -> None:
    """Draw a fraction of the incident energy with its scatter over ``x`` (z,)."""
    scatter = data[f"{name}_scatter"].values
    _with_scatter(x, data[name].values, scatter, style.CURVES[name], LABELS[name]).draw(axes)


def _draw_bands(axes: Axes, data: xr.Dataset) -> None:
    """Draw what leaves in every band (a colour and a line), forward, and backward with circles."""
    z = data["z"].values
    bands = data["band"].values.tolist()
    directions = data["direction"].values.tolist()
    for i, number in enumerate(bands):
        for direction, marks in MARKS.items():
            j = directions.index(direction)
            value = data["share"].values[:, i, j]
            # Below the floor a curve would be a line of noise across the panel.
            value = np.where(value > FLOOR, value, np.nan)
            label = f"band {number}" if direction == "forward" else None
            look = style.band_look(number) | marks
            _with_scatter(z, value, data["share_scatter"].values[:, i, j], look, label).draw(axes)


def _with_scatter(
    x: np.ndarray, value: np.ndarray, scatter: np.ndarray, look: Mapping[str, Any], label: str | None
) -> Series:
    """Return a curve with its scatter over the runs at each z, one deviation up and down; all are (z,)."""
    return Series(x, value, {"lw": 1.0, **look}, label, band=(value - scatter, value + scatter))
