"""Pictures of one run: where its energy is, its dispersion, impacts and energy ledger; the bands of a cell."""

from itertools import cycle

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.panels import KAPPA, empty_figure, panel_title
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands

CELLS = {
    "dispersion_before": ("Before the first site", style.BLUE),
    "dispersion_after": ("After the first site", style.VERMILION),
    "dispersion": ("All cells", style.BLACK),
}
LARGEST_RESIDUAL = 1e-8  # of the ledger, over the work of the drive


def spacetime(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Kinetic energy (J) of every cell over time with the sites marked, beside the wavenumber content."""
    if analysis is None or analysis.sizes.get("time", 0) < 2:
        return empty_figure("Kinetic energy: needs the analysis of a run with two samples or more")
    energy, cells, time = analysis["kinetic_energy"], analysis["cell"].values, analysis["time"].values
    has_content = "wavenumber_content" in analysis
    figure = style.new_figure(style.PAGE if has_content else style.COLUMN, 2.5)
    left, *right = np.atleast_1d(figure.subplots(1, 1 + has_content))
    if len(cells) == 1:
        left.plot(time, energy[:, 0], color=style.BLUE, lw=0.6)
        left.set(xlabel="Time (s)", ylabel=f"Kinetic energy of cell {cells[0]} (J)", xlim=time[[0, -1]])
    else:
        image = panels.space_time_map(left, energy, panels.log_norm(energy), run)
        panels.colour_bar(figure, image, left, "Kinetic energy of a cell (J)", pad=0.02)
        if len(panels.recorded_sites(run)):
            left.legend(loc="upper left", labelcolor="white", handletextpad=0.3)
    for axes in right:
        content = analysis["wavenumber_content"].load()
        image = panels.content_map(axes, content, panels.log_norm(content, decades=4))
        axes.set(xlabel="Time (s)", ylabel=KAPPA, ylim=(0, content["wavenumber"][-1] / np.pi))
        panel_title(left, "(a) Kinetic energy")
        panel_title(axes, "(b) Wavenumber content")
        panels.colour_bar(figure, image, axes, "Kinetic energy per bin (J)", pad=0.02)
    return figure


def dispersion(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """2-D spectra of the cells before and after the first site, and their sums over wavenumber."""
    measured = [name for name in CELLS if analysis is not None and name in analysis]
    if analysis is None or not measured:
        return empty_figure("Dispersion: needs the analysis of a run that recorded two cells or more")
    model = Case.of(run).model()
    cell = model.chain.cell
    spectra = panels.below_cutoff(analysis, cell, [name for name in measured if name != "dispersion"] or measured)
    norm = panels.log_norm(*spectra.values())

    figure = style.new_figure(style.PAGE if len(spectra) > 1 else 5.0, 3.2)
    widths = [1.0] * len(spectra) + [0.55]
    *maps, side = figure.subplots(1, len(spectra) + 1, sharey=True, width_ratios=widths)
    for axes, tag, (name, spectrum) in zip(maps, "ab", spectra.items(), strict=False):
        image = panels.dispersion_map(axes, spectrum, norm, cell)
        axes.set_xlabel(KAPPA)
        panel_title(axes, f"({tag}) {CELLS[str(name)][0]}")
    maps[0].set_ylabel(panels.OMEGA)
    panels.colour_bar(figure, image, [*maps, side], "Mean kinetic energy per bin (J)")

    # In sums over the wavenumber what reaches the upper bands can be read off.
    panels.shade_bands(side, ((band.low, band.high) for band in pass_bands(cell)))
    sums = {str(name): spectrum.sum("wavenumber") for name, spectrum in spectra.items()}
    for name, energy in sums.items():
        text, colour = CELLS[name]
        side.plot(np.maximum(energy, 1e-300), energy["frequency"] / 1e3, color=colour, lw=0.7,
                  label=text.split()[0].lower())  # fmt: skip
    drive, largest = model.drive.frequency / 1e3, max(float(energy.max()) for energy in sums.values()) or 1.0
    side.axhline(drive, color=style.BLACK, lw=0.6, ls=":")
    side.set(xscale="log", xlim=(largest * 1e-7, largest * 3), xlabel="Energy (J)")
    panels.note(side, "drive", (1, drive), (-2, 2), xycoords=("axes fraction", "data"), ha="right", va="bottom")
    side.legend(loc="lower right")
    panel_title(side, f"({'abc'[len(spectra)]}) Sum over κ")
    return figure


def impacts(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Onset of every contact episode by site and side, coloured by approach speed; energy lost per site."""
    sites = run["sites/cell"].values
    names = "site", "side", "onset", "approach_velocity", "loss"
    site, side, onset, velocity, lost = (run[f"impacts/{name}"].values for name in names)
    if not len(sites):
        return empty_figure("Impacts: the lattice has no contact sites")
    if not len(site):
        return empty_figure("Impacts: no contact in this run")
    figure = style.new_figure(style.PAGE, min(1.3 + 0.24 * len(sites), 4.5))
    raster, bars = figure.subplots(1, 2, sharey=True, width_ratios=(4, 1))
    speed = np.abs(velocity)
    norm = panels.log_norm(speed, decades=2)
    for sign, marker, shift in ((1, "^", 0.13), (-1, "v", -0.13)):
        at = side == sign
        image = raster.scatter(onset[at], site[at] + shift, 14, speed[at], marker=marker, lw=0, norm=norm,
                               cmap="viridis_r", rasterized=True)  # fmt: skip
    number = np.arange(1, len(sites) + 1)
    raster.set_yticks(number, [f"{c}" for c in sites])
    raster.set(xlabel="Time (s)", ylabel="Contact site (cell)", xlim=run["time"][[0, -1]], ylim=(0.4, len(sites) + 0.6))
    raster.grid(axis="y", color=style.PALE, lw=0.5)
    raster.set_axisbelow(True)
    panels.colour_bar(figure, image, raster, "Approach speed (m/s)")
    panel_title(raster, f"(a) {len(site)} contact episodes (▲ positive side, ▼ negative side)")

    index = site.astype(int) - 1
    loss, episodes = np.bincount(index, np.nan_to_num(lost), len(sites)), np.bincount(index, minlength=len(sites))
    bars.bar_label(bars.barh(number, loss, 0.6, color=style.VERMILION), episodes, padding=2, fontsize=6.5)
    bars.set(xlabel="Energy lost (J)", xlim=(0, 1.25 * max(loss.max(), 1e-300)))
    bars.tick_params(left=False)
    panel_title(bars, "(b) Loss, episodes")
    return figure


def ledger(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Energies over time, and below them the residual relative to the work done, on a log scale."""
    time = run["time"].values
    names = "kinetic", "spring", "contact", "work", "dissipated"
    kinetic, spring, contact, work, dissipated = (run[f"energy/{name}"].values for name in names)
    largest = np.abs(work).max()
    if len(time) < 2 or largest == 0:
        return empty_figure("Energy ledger: the drive has done no work")
    figure = style.new_figure(style.COLUMN, 3.3)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    factor, prefix = style.si_prefix(largest)
    # Both swing at twice the drive's frequency, which no page can resolve; means over two periods can be seen.
    window = int(np.ceil(4 * np.pi / Case.of(run).model().drive.frequency / (time[1] - time[0])))
    stored = kinetic + spring + contact
    curves = (
        ("work of the drive", work, style.BLACK, "-"),
        ("kinetic + potential", stored, style.BLUE, "-"),
        ("dissipated", dissipated, style.VERMILION, "-"),
        ("kinetic, mean", _running_mean(kinetic, window), style.SKY, "-"),
        ("springs, mean", _running_mean(spring, window), style.GREEN, (0, (3, 1.5))),
        ("contacts", contact, style.PURPLE, "-"),
    )
    for label, energy, colour, dashes in curves:
        upper.plot(time, energy / factor, color=colour, ls=dashes, label=label, lw=0.9)
    upper.set(ylabel=f"Energy ({prefix}J)", ylim=(-0.03 * largest / factor, 1.4 * largest / factor))
    upper.legend(loc="upper center", ncol=2, columnspacing=1.2, labelspacing=0.25)

    residual = np.abs(work - dissipated - stored) / largest
    lower.semilogy(time, np.maximum(residual, 1e-18), color=style.BLACK, lw=0.5)
    lower.axhline(LARGEST_RESIDUAL, color=style.VERMILION, lw=0.7, ls=style.DASHED)
    panels.note(lower, "limit 1e-8", (0.99, LARGEST_RESIDUAL), (0, 1.5), xycoords=("axes fraction", "data"),
                ha="right", va="bottom", color=style.VERMILION)  # fmt: skip
    lower.set(xlabel="Time (s)", ylabel="|Residual| / work", xlim=time[[0, -1]])
    lower.set_ylim(1e-15, max(1e-6, 10 * residual.max()))
    return figure


def _running_mean(values: np.ndarray, samples: int) -> np.ndarray:
    """Mean over ``samples``, over fewer at the ends."""
    window = np.ones(min(samples, len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")


def bands(cell: UnitCell, frequency: float | None = None) -> Figure:
    """Frequency against wavenumber and against group velocity; gaps shaded, a drive ``frequency`` (rad/s) marked."""
    point, passing = bloch(cell, np.linspace(0, np.pi, 361)), pass_bands(cell)
    figure = style.new_figure(style.PAGE * 0.72, 3.0)
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.3, 1))
    panels.band_diagram(left, cell, frequency)
    for branch, speed, band, colour in zip(
        point.frequency.T, point.group_velocity.T, passing, cycle(style.SERIES), strict=False
    ):
        right.plot(speed, branch / 1e3, color=colour)
        at = 1.0, (band.low + band.high) / 2e3
        panels.note(left, f"{band.number}", at, (3, 0), va="center", fontsize=8, color=colour)
    panels.shade_bands(right, gaps(passing))
    if frequency is not None:
        right.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    right.set(xlabel="Group velocity dω/dκ (cells/s)")
    right.axvline(0, color=style.GREY, lw=0.5)
    panel_title(left, "(a) Bands; gaps shaded")
    panel_title(right, "(b) Group velocity")
    return figure
