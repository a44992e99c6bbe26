"""The impact log as a raster: which site collides when, how fast, and what it costs."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.panels import colour_bar, empty_figure, log_norm, panel_title


def impacts(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Onset of every contact episode by site and side, coloured by approach speed; energy lost per site."""
    sites = run["sites/cell"].values
    site, side, onset, velocity, lost = (
        run[f"impacts/{name}"].values for name in ("site", "side", "onset", "approach_velocity", "loss")
    )
    if not len(sites):
        return empty_figure("Impacts: the lattice has no contact sites")
    if not len(site):
        return empty_figure("Impacts: no contact in this run")
    figure = style.new_figure(style.PAGE, min(1.3 + 0.24 * len(sites), 4.5))
    raster, bars = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": (4, 1)})
    speed = np.abs(velocity)
    norm = log_norm(speed.max(), 2)
    for sign, marker, shift in ((1, "^", 0.13), (-1, "v", -0.13)):
        at = side == sign
        image = raster.scatter(onset[at], site[at] + shift, 14, speed[at], marker=marker, lw=0, norm=norm,
                               cmap="viridis_r", rasterized=True)  # fmt: skip
    number = np.arange(1, len(sites) + 1)
    raster.set_yticks(number, [f"{c}" for c in sites])
    raster.set(xlabel="Time (s)", ylabel="Contact site (cell)", xlim=run["time"][[0, -1]], ylim=(0.4, len(sites) + 0.6))
    raster.grid(axis="y", color=style.PALE, lw=0.5)
    raster.set_axisbelow(True)
    colour_bar(figure, image, raster, "Approach speed (m/s)")
    panel_title(raster, f"(a) {len(site)} contact episodes (▲ positive side, ▼ negative side)")

    loss = np.bincount(site.astype(int) - 1, np.nan_to_num(lost), len(sites))
    bars.barh(number, loss, 0.6, color=style.VERMILION)
    for i, count in enumerate(np.bincount(site.astype(int) - 1, minlength=len(sites))):
        bars.annotate(f"{count}", (max(loss[i], 0), i + 1), (2, 0), textcoords="offset points", va="center",
                      fontsize=6.5)  # fmt: skip
    bars.set(xlabel="Energy lost (J)", xlim=(0, 1.25 * max(loss.max(), 1e-300)))
    bars.tick_params(left=False)
    panel_title(bars, "(b) Loss, episodes")
    return figure
