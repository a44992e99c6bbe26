"""The scattering law of one site: shares over z, those of bands and directions, and the onset from close by."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from vipetsc.figures import style

SHARES = {
    "transmitted": ("T, transmitted", style.BLUE),
    "reflected": ("R, reflected", style.SKY),
    "upper": ("U, upper bands", style.VERMILION),
    "dissipated": ("L, dissipated", style.ORANGE),
}
COLOURS = style.VERMILION, style.PURPLE, style.GREEN, style.YELLOW, style.GREY
FLOOR = 1e-5  # of a share that a logarithmic axis shows


def law(data: xr.Dataset) -> Figure:
    """Three panels over z: T, R, U and L; what leaves by band and direction; T, U and U/(1-T) from the onset on."""
    z, best = data["z"].values, float(data.attrs["matched_z"])
    figure = style.new_figure(style.PAGE, 2.9)
    left, middle, right = figure.subplots(1, 3)
    for name, (label, colour) in SHARES.items():
        _curve(left, z, data[name].values, data[f"{name}_scatter"].values, colour, "-", label)
    drive, colours = int(data.attrs["drive_band"]), iter(COLOURS * len(data["band"]))
    for number in data["band"].values:
        colour = style.BLUE if number == drive else next(colours)
        for way, line in (("forward", "-"), ("backward", "--")):
            of = {"band": data["band"].values == number, "direction": data["direction"].values == way}
            share, scatter = (
                data[name].values[:, of["band"]][:, 0][:, of["direction"]][:, 0] for name in ("share", "share_scatter")
            )
            _curve(
                middle,
                z,
                np.where(share > FLOOR, share, np.nan),
                scatter,
                colour,
                line,
                f"band {number}" if way == "forward" else "",
            )
    over = z - 1
    for name in ("transmitted", "upper"):
        label, colour = SHARES[name]
        _curve(right, over, data[name].values, data[f"{name}_scatter"].values, colour, "-", label)
    efficiency = np.where(data["efficiency"].values > 0, data["efficiency"].values, np.nan)
    right.plot(over, efficiency, color=style.BLACK, lw=1.2, label="U/(1 - T)")
    for axes in (left, middle):
        axes.set(xscale="log", xlabel="z = linear displacement / clearance", xlim=(0.9, z[-1]))
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if z[-1] > 20 else (1.0, 2.0, 5.0)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    left.set(ylim=(0, 1.02), ylabel="share of the energy that arrives")
    middle.set(yscale="log", ylim=(FLOOR / 10, 1.5))
    right.set(xscale="log", xlabel="z - 1", xlim=(max(over[1] / 2, 1e-4), 3), ylim=(0, 1.02))
    if np.isfinite(best):
        for axes, at in ((left, best), (middle, best), (right, best - 1)):
            axes.axvline(at, color=style.GREY, lw=0.8, ls=style.DOTTED)
        right.set_title(f"z* = {best:.3g}, T = {float(data.attrs['matched_transmitted']):.3g}", fontsize=8)
    left.set_title("T + R + U + L + other bands = 1", fontsize=8)
    middle.set_title("by band; dashed: backward", fontsize=8)
    left.legend(fontsize=6, loc="center right")
    middle.legend(fontsize=6, loc="lower left", ncols=2)
    right.legend(fontsize=6, loc="center left", bbox_to_anchor=(0.0, 0.45))
    return figure


def _curve(axes: Axes, x: np.ndarray, y: np.ndarray, scatter: np.ndarray, colour: str, line: str, label: str) -> None:
    """A curve with its scatter, one deviation either way."""
    axes.plot(x, y, color=colour, ls=line, lw=1.0, label=label or None)
    axes.fill_between(x, y - scatter, y + scatter, color=colour, alpha=0.25, lw=0)
