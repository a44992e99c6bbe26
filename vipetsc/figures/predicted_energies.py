"""A prediction over the simulated transfer: upper bands, each band, what is dissipated, how hard sites are met."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import panels, style

LEAST = 1e-4  # of the work, the smallest energy shown
MOST_SITES = 6  # with a name in the legend
LOOKS: dict[str, dict[str, Any]] = {"predicted": {"lw": 1.2}, "simulated": {"ls": "", "marker": "o", "ms": 3.2}}


def prediction(data: xr.Dataset) -> Figure:
    """Draw energies at the end over the drive's work against amplitude, predicted (lines) and simulated (points)."""
    bands = data["band"].values
    name = "upper" if int(data.attrs["drive_band"]) < len(bands) else "other"
    title = "Bands above the driven one" if name == "upper" else "All bands except the driven one"
    figure = style.new_figure(style.PAGE, 4.9)
    grid = figure.subplots(2, 2, sharex=True)
    (transferred, dissipated), (every_band, sites) = grid

    _draw_total(transferred, data, name)
    transferred.set(title=title, ylabel="Energy at the end / work", xscale="log", yscale="log")
    transferred.set_ylim(max(LEAST, _least(data, name) / 1.5), None)

    _draw_total(dissipated, data, "dissipated")
    dissipated.set(title="Dissipated", ylabel="Energy / work", ylim=(0, None))

    _draw_bands(every_band, data)
    every_band.set(title="Every band", ylabel="Energy at the end / work", yscale="log", ylim=(LEAST, 1.5))

    for site, z in zip(data["sites/cell"].values, data["predicted/z"].values.T, strict=True):
        label = f"cell {site}" if data.sizes["site"] <= MOST_SITES else None
        sites.plot(data["amplitude"].values, z, lw=0.9, label=label)
    sites.set(title="Wave that arrives at the sites", ylabel="Displacement / clearance", yscale="log")

    for axes in grid.flat:
        axes.axvline(float(data.attrs["onset_amplitude"]), color=style.GREY, lw=0.7, ls=style.DOTTED)
    for axes in (transferred, every_band, sites):
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best", fontsize=6.5, framealpha=0.8)
    for axes in grid[1]:
        axes.set_xlabel("Amplitude (N); dotted: first contact")

    # A prediction without simulated runs to compare with has no error.
    rms = data.attrs.get(f"rms_{name}")
    if rms is not None:
        transferred.set_title(f"{title}: rms {rms:.3f} decades")
        dissipated.set_title(f"Dissipated: error at most {data.attrs['worst_dissipated']:.3f}")
    panels.label_panels(grid.ravel())
    return figure


def _draw_total(axes: Axes, data: xr.Dataset, name: str) -> None:
    """Draw one energy in black, predicted and simulated."""
    for kind, look in LOOKS.items():
        if f"{kind}/{name}" in data:
            values = data[f"{kind}/{name}"].values
            axes.plot(data["amplitude"].values, values, color=style.BLACK, label=kind, **look)


def _draw_bands(axes: Axes, data: xr.Dataset) -> None:
    """Draw the energy of every band in its colour, predicted and simulated; the lines have the labels."""
    for i, band in enumerate(data["band"].values):
        of_band = {"predicted": style.band_look(int(band)), "simulated": {"color": style.band_colour(int(band))}}
        for kind, look in LOOKS.items():
            if f"{kind}/bands" in data:
                values = data[f"{kind}/bands"].values[:, i]
                label = f"band {band}" if kind == "predicted" else None
                axes.plot(data["amplitude"].values, values, label=label, **of_band[kind] | look)


def _least(data: xr.Dataset, name: str) -> float:
    """Return the smallest positive energy above the onset, predicted or simulated; 1 without any."""
    touches = data["amplitude"].values > float(data.attrs["onset_amplitude"])
    values = [data[f"{kind}/{name}"].values[touches] for kind in LOOKS if f"{kind}/{name}" in data]
    together = np.concatenate(values)
    return float(together[together > 0].min(initial=1.0))
