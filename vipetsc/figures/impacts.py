"""The impact log as a raster: which site collides when, how fast, and what it costs."""

from __future__ import annotations

import h5py
import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.io.run_file import RunFile


def impacts(run: RunFile, analysis: h5py.File | None) -> Figure:
    """Onset of every contact episode by site and side, coloured by approach speed; energy lost per site."""
    log, sites = run.impacts, run.site_cells
    if not len(sites):
        return style.without_data("Impacts: the lattice has no contact sites")
    if not len(log["onset"]):
        return style.without_data("Impacts: no contact in this run")
    figure = style.new_figure(style.PAGE, min(1.3 + 0.24 * len(sites), 4.5))
    raster, bars = figure.subplots(1, 2, sharey=True, gridspec_kw={"width_ratios": (4, 1)})
    speed = np.abs(log["approach_velocity"])
    norm = style.log_norm(speed.max(), 2)
    for side, marker, shift in ((1, "^", 0.13), (-1, "v", -0.13)):
        chosen = log["side"] == side
        image = raster.scatter(log["onset"][chosen], log["site"][chosen] + shift, 14, speed[chosen], marker=marker,
                               lw=0, norm=norm, cmap="viridis_r", rasterized=True)  # fmt: skip
    raster.set_yticks(np.arange(1, len(sites) + 1), [f"{c}" for c in sites])
    raster.set(xlabel="Time (s)", ylabel="Contact site (cell)", xlim=run.time[[0, -1]], ylim=(0.4, len(sites) + 0.6))
    raster.grid(axis="y", color=style.PALE, lw=0.5)
    raster.set_axisbelow(True)
    figure.colorbar(image, ax=raster, label="Approach speed (m/s)", pad=0.01, extend="min")
    style.letter(raster, f"(a) {len(speed)} contact episodes (▲ positive side, ▼ negative side)")

    place = log["site"].astype(int) - 1
    loss = np.bincount(place, np.nan_to_num(log["loss"]), len(sites))
    count = np.bincount(place, minlength=len(sites))
    bars.barh(np.arange(1, len(sites) + 1), loss, 0.6, color=style.VERMILION)
    for i, (number, value) in enumerate(zip(count, loss, strict=True)):
        bars.annotate(
            f"{number}", (max(value, 0), i + 1), (2, 0), textcoords="offset points", va="center", fontsize=6.5
        )
    bars.set(xlabel="Energy lost (J)", xlim=(0, 1.25 * max(loss.max(), 1e-300)))
    bars.tick_params(left=False)
    style.letter(bars, "(b) Loss, episodes")
    return figure
