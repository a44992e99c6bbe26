"""A prediction over the simulated transfer: upper bands, each band, what is dissipated, how hard sites are met."""

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures import style

COLOURS = style.BLACK, style.BLUE, style.VERMILION, style.GREEN, style.ORANGE, style.PURPLE, style.SKY, style.GREY
LEAST = 1e-4  # of the work, the smallest share shown


def prediction(data: xr.Dataset) -> Figure:
    """Shares of the drive's work at the end against amplitude, predicted (lines) and simulated (points)."""
    figure = style.new_figure(style.PAGE, 4.9)
    grid = figure.subplots(2, 2, sharex=True)
    amplitude, onset = data["amplitude"].values, float(data.attrs["onset_amplitude"])
    drive, bands = int(data.attrs["drive_band"]), data["band"].values
    name = "upper" if drive < len(bands) else "other"
    text = "Bands above the driven one" if name == "upper" else "All bands but the driven one"
    rows = [(grid[0, 0], name, style.BLACK, ""), (grid[0, 1], "dissipated", style.BLACK, "")]
    rows += [(grid[1, 0], "bands", COLOURS[i % len(COLOURS)], f"band {b}") for i, b in enumerate(bands)]
    for axes, key, colour, label in rows:
        for kind, look in (("predicted", {"lw": 1.2}), ("simulated", {"ls": "", "marker": "o", "ms": 3.2})):
            if f"{kind}/{key}" in data:
                values = data[f"{kind}/{key}"].values
                values = values[:, bands.tolist().index(int(label.split()[1]))] if label else values
                axes.plot(amplitude, values, color=colour, label=label or kind if kind == "predicted" or not label
                          else None, **look)  # fmt: skip
    for site, z in zip(data["sites/cell"].values, data["predicted/z"].values.T, strict=True):
        axes = grid[1, 1]
        axes.plot(amplitude, z, lw=0.9, label=f"cell {site}" if data.sizes["site"] <= 6 else None)
    grid[0, 0].set(title=text, ylabel="Energy at the end / work", xscale="log", yscale="log")
    grid[0, 1].set(title="Dissipated", ylabel="Energy / work", ylim=(0, None))
    grid[1, 0].set(title="Every band", ylabel="Energy at the end / work", yscale="log", ylim=(LEAST, 1.5))
    grid[1, 1].set(title="What arrives at the sites", ylabel="Displacement / clearance", yscale="log")
    grid[0, 0].set_ylim(max(LEAST, _least(data, name) / 1.5), None)
    for axes in grid.flat:
        axes.axvline(onset, color=style.GREY, lw=0.7, ls=style.DOTTED)
    for axes in (grid[0, 0], grid[1, 0], grid[1, 1]):
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="best", fontsize=6.5, framealpha=0.8)
    for axes in grid[1]:
        axes.set_xlabel("Amplitude (N); dotted: first contact")
    if (rms := data.attrs.get(f"rms_{name}")) is not None:
        grid[0, 0].set_title(f"{text}: rms {rms:.3f} decades")
        grid[0, 1].set_title(f"Dissipated: off by {data.attrs['worst_dissipated']:.3f} at most")
    return figure


def _least(data: xr.Dataset, name: str) -> float:
    """The smallest positive share above the onset."""
    some = data["amplitude"].values > float(data.attrs["onset_amplitude"])
    values = np.concatenate(
        [data[key].values[some] for key in (f"predicted/{name}", f"simulated/{name}") if key in data]
    )
    return float(values[values > 0].min(initial=1.0))
