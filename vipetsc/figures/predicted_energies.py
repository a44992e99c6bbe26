"""A prediction next to simulated runs: energies of the upper bands and of each band, losses, the wave at each site."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.page import Page

LEAST = 1e-4  # smallest energy shown, over the work
WHOLE = 1.5  # upper limit of an axis on which an energy may be as large as the work
MOST_SITES = 6  # sites that have a name in the legend: as many as there are dashes
LOOKS: dict[str, dict[str, Any]] = {"predicted": {"lw": 1.2}, "simulated": {"ls": "", "marker": "o", "ms": 3.2}}
LOSSES = {"dissipated": "contacts", "dashpots": "dashpots", "absorbed": "those of the ends"}
MARKERS = "os^Dvp"  # of the simulated energies of bands, so that they too can be told apart in greyscale print
ROW = 0.075  # height of a legend's row, as a fraction of the height of the axes
SIDES = 0.04  # left and right of all amplitudes, as a fraction of their range in logarithms
MARGIN = 0.04  # above and below a legend together


def prediction(data: xr.Dataset) -> Figure:
    """Draw energies at the end over the drive's work against amplitude, predicted (lines) and simulated (points).

    A fourth panel has the predicted displacement of the wave that arrives at each site, over the clearance.
    """
    bands = data["band"].values
    name = "upper" if int(data.attrs["drive_band"]) < len(bands) else "other"
    title = "Bands above the driven one" if name == "upper" else "All bands except the driven one"
    page = Page.of(2, 2, height=4.9, count=4, sharex=True)
    transferred, dissipated, every_band, sites = page.panels

    _draw_total(transferred, data, name)
    transferred.set(title=title, ylabel="Energy at the end / work", xscale="log", yscale="log")
    # The axis begins at what contacts transfer: members without contact have rounding errors, far below.
    low = max(LEAST, _least(data, name) / 1.5)
    high = transferred.get_ylim()[1]
    if high <= low:
        # Nothing reaches the axis.
        high = WHOLE
    transferred.set_ylim(low, high)
    _put_legend_above(transferred, columns=2)

    _draw_losses(dissipated, data)
    dissipated.set(title="Dissipated", ylabel="Energy / work")
    dissipated.set_ylim(0, None)

    _draw_bands(every_band, data)
    every_band.set(title="Every band", ylabel="Energy at the end / work", yscale="log", ylim=(LEAST, WHOLE))
    _put_legend_above(every_band, columns=4)

    _draw_sites(sites, data)
    sites.set(title="Wave that arrives at the sites", ylabel="Displacement / clearance", yscale="log")
    if sites.get_legend_handles_labels()[0]:
        _put_legend_above(sites, columns=3)

    onset = float(data.attrs["onset_amplitude"])
    for axes in page.panels:
        axes.axvline(onset, color=style.GREY, lw=0.7, ls=style.DOTTED)
    _show_amplitudes(transferred, np.append(data["amplitude"].values, onset))
    for axes in (every_band, sites):
        axes.set_xlabel(f"Amplitude ({data['amplitude'].attrs['units']}); dotted: first contact")

    # A prediction without simulated runs to compare with has no error.
    rms = data.attrs.get(f"rms_{name}")
    if rms is not None:
        transferred.set_title(f"{title}: rms {rms:.3f} decades")
        # A lattice without dashpots has no such error.
        worst = max(data.attrs["worst_dissipated"], data.attrs.get("worst_dashpots", 0.0))
        dissipated.set_title(f"Dissipated: error at most {worst:.3f}")
    return page.lettered()


def _draw_total(axes: Axes, data: xr.Dataset, name: str) -> None:
    """Draw one energy, predicted with a line and simulated."""
    for kind, look in LOOKS.items():
        if f"{kind}/{name}" in data:
            values = data[f"{kind}/{name}"].values
            axes.plot(data["amplitude"].values, values, label=kind, **{**style.CURVES[f"predicted/{name}"], **look})


def _draw_losses(axes: Axes, data: xr.Dataset) -> None:
    """Draw what contacts dissipate, what dashpots do if there are any, and those of absorbing ends alone."""
    losses = [name for name in LOSSES if f"predicted/{name}" in data]
    for name in losses:
        _draw_total(axes, data, name)
    if len(losses) > 1:
        # One entry for each loss; the first panel explains lines and points.
        handles = [axes.plot([], [], label=LOSSES[name], **style.CURVES[f"predicted/{name}"])[0] for name in losses]
        axes.set_ylim(0, 1.25)
        axes.legend(handles=handles, loc="upper left", ncols=len(losses), columnspacing=0.8)


def _draw_bands(axes: Axes, data: xr.Dataset) -> None:
    """Draw the energy of every band in its colour, predicted and simulated, with one label for both."""
    amplitude = data["amplitude"].values
    for i, band in enumerate(data["band"].values):
        look = style.band_look(int(band)) | LOOKS["predicted"]
        points = {"color": look["color"]} | LOOKS["simulated"] | {"marker": MARKERS[i % len(MARKERS)]}
        axes.plot(amplitude, data["predicted/bands"].values[:, i], **look)
        if "simulated/bands" in data:
            axes.plot(amplitude, data["simulated/bands"].values[:, i], **points)
            look |= {"marker": points["marker"], "ms": points["ms"]}
        axes.plot([], [], label=f"band {band}", **look)


def _draw_sites(axes: Axes, data: xr.Dataset) -> None:
    """Draw the wave that arrives at every site; if the sites are few, each has a name and dashes of its own."""
    few = data.sizes["site"] <= MOST_SITES
    for i, (site, z) in enumerate(zip(data["sites/cell"].values, data["predicted/z"].values.T, strict=True)):
        label = f"cell {site}" if few else None
        line = style.BAND_DASHES[i] if few else "-"
        axes.plot(data["amplitude"].values, z, lw=0.9, ls=line, label=label)


def _show_amplitudes(axes: Axes, amplitudes: np.ndarray) -> None:
    """Set the limits of a logarithmic axis a little beyond all ``amplitudes``: a line on the frame is not seen."""
    shown = amplitudes[amplitudes > 0]
    margin = (shown.max() / shown.min()) ** SIDES
    axes.set_xlim(shown.min() / margin, shown.max() * margin)


def _put_legend_above(axes: Axes, columns: int) -> None:
    """Put the legend of logarithmic ``axes`` above all that they show, and raise their upper limit to make room."""
    entries = len(axes.get_legend_handles_labels()[0])
    room = MARGIN + ROW * -(-entries // columns)
    low, high = axes.get_ylim()
    # ln(new / low) = ln(high / low) (1 + room / (1 - room)): the old range is the fraction 1 - room of the new one.
    axes.set_ylim(low, high * (high / low) ** (room / (1 - room)))
    axes.legend(loc="upper left", ncols=columns, columnspacing=0.8, handlelength=style.DASHES_SEEN)


def _least(data: xr.Dataset, name: str) -> float:
    """Return the smallest positive energy above the onset, predicted or simulated; ``LEAST`` without any."""
    touches = data["amplitude"].values > float(data.attrs["onset_amplitude"])
    values = [data[f"{kind}/{name}"].values[touches] for kind in LOOKS if f"{kind}/{name}" in data]
    together = np.concatenate(values)
    positive = together[together > 0]
    if not len(positive):
        return LEAST
    return float(positive.min())
