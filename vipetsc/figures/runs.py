"""Pictures of one run: where its energy is, its dispersion, impacts, ledger, phase portraits; a cell's bands."""

import json

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from scipy.interpolate import Akima1DInterpolator, CubicHermiteSpline

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.panels import empty_figure
from vipetsc.io.read import field_time, leading_site
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands
from vipetsc.lattice.damped import decay_length

CELLS = {
    "dispersion_before": ("Before the first site", style.BLUE),
    "dispersion_after": ("After the first site", style.VERMILION),
    "dispersion": ("All cells", style.BLACK),
}
LARGEST_RESIDUAL = 1e-8  # of the ledger, over the work of the drive
ROWS, MARKERS = 16, 2000  # sites with a row, and episodes with a marker, of their own
ROWS_OF_A_MAP, COLUMNS_OF_A_MAP = 150, 300
REFINE = 10  # points of a phase portrait drawn for each sample


def spacetime(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Kinetic energy (J) of every cell over time with the sites marked, beside the wavenumber content."""
    if analysis is None or analysis.sizes.get("time", 0) < 2:
        return empty_figure("Kinetic energy: needs the analysis of a run with two samples or more")
    energy, cells, time = analysis["kinetic_energy"], analysis["cell"].values, analysis["time"].values
    has_content = "wavenumber_content" in analysis
    figure = style.new_figure(style.PAGE if has_content else style.COLUMN, 2.5)
    left, *right = np.atleast_1d(figure.subplots(1, 1 + has_content))
    if len(cells) == 1:
        left.plot(time, energy[:, 0], lw=0.6)
        left.set(xlabel="Time (s)", ylabel=f"Kinetic energy of cell {cells[0]} (J)", xlim=time[[0, -1]])
    else:
        image = panels.space_time_map(left, energy, panels.log_norm(energy), run)
        panels.colour_bar(image, left, "Kinetic energy of a cell (J)")
        if len(panels.recorded_sites(run)):
            left.legend(loc="upper left", labelcolor="white", handletextpad=0.3)
    for axes in right:
        content = analysis["wavenumber_content"].load()
        image = panels.content_map(axes, content, panels.log_norm(content, decades=4))
        left.set_title("(a) Kinetic energy")
        axes.set_title("(b) Wavenumber content")
        panels.colour_bar(image, axes, "Kinetic energy per bin (J)")
    return figure


def dispersion(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """2-D spectra of the cells before and after the first site, and their sums over wavenumber."""
    measured = [name for name in CELLS if analysis is not None and name in analysis]
    if analysis is None or not measured:
        return empty_figure("Dispersion: needs the analysis of a run that recorded two cells or more")
    model = Case.of(run).model()
    cell = model.chain.cell
    spectra = panels.below_cutoff(analysis, cell, [name for name in measured if name != "dispersion"] or measured)
    norm, largest = panels.log_norm(*spectra.values()), float(spectra.sum("wavenumber").to_array().max()) or 1.0

    figure = style.new_figure(style.PAGE if len(spectra) > 1 else 5.0, 3.2)
    widths = [1.0] * len(spectra) + [0.55]
    *maps, side = figure.subplots(1, len(spectra) + 1, sharey=True, width_ratios=widths)
    # In sums over the wavenumber what reaches the upper bands can be read off.
    panels.shade_bands(side, ((band.low, band.high) for band in pass_bands(cell)))
    for axes, tag, (name, spectrum) in zip(maps, "ab", spectra.items(), strict=False):
        text, colour = CELLS[str(name)]
        image = panels.dispersion_map(axes, spectrum, norm, cell)
        axes.set_title(f"({tag}) {text}")
        axes.label_outer()
        energy = np.maximum(spectrum.sum("wavenumber"), 1e-300)
        side.plot(energy, energy["frequency"] / 1e3, color=colour, lw=0.7, label=text.split()[0].lower())
    panels.colour_bar(image, [*maps, side], "Mean kinetic energy per bin (J)")
    drive = model.drive.frequency / 1e3
    side.axhline(drive, color=style.BLACK, lw=0.6, ls=":")
    panels.note(
        side,
        "drive" if model.drive.amplitude else "motion",
        (1, drive),
        (-2, 2),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
    )
    side.set(xscale="log", xlim=(largest * 1e-7, largest * 3), xlabel="Energy (J)")
    side.set_title(f"({'abc'[len(spectra)]}) Sum over κ")
    side.legend(loc="lower right")
    return figure


def impacts(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Onset of every contact episode by site and side, coloured by approach speed; energy lost per site.

    More sites or episodes than ``ROWS`` and ``MARKERS`` become a map of the largest approach speed. Contacts that touch
    or are pressed from the beginning have no impacts: a map of their indentation.
    """
    sites = run["sites/cell"].values
    names = "site", "side", "onset", "approach_velocity", "loss"
    site, side, onset, velocity, lost = (run[f"impacts/{name}"].values for name in names)
    if not len(sites):
        return empty_figure("Impacts: the lattice has no contact sites")
    if not len(site):
        return empty_figure("Impacts: no contact in this run")
    model = Case.of(run).model()
    lasting = bool(model.gaps) and max(min(gap) for gap in model.gaps) <= 0 and "displacement" in run
    figure = style.new_figure(style.PAGE, min(1.3 + 0.24 * len(sites), 4.5))
    raster, bars = figure.subplots(1, 2, sharey=True, width_ratios=(4, 1))
    speed, number, index = np.abs(velocity), np.arange(1, len(sites) + 1), site.astype(int) - 1
    norm, span = panels.log_norm(speed, decades=2), run["time"].values[[0, -1]]
    few, colours = len(sites) <= ROWS and len(site) <= MARKERS, {"norm": norm, "cmap": "viridis_r"}
    title, about = f"(a) {len(site)} contact episodes", "Largest approach speed (m/s)"
    if lasting and len(run["cell"]) == model.chain.cells:
        few, title, about, depth = False, "(a) Indentation", "Indentation (m)", panels.indentations(run, model)
        image = panels.draw_map(raster, field_time(run), number, depth, panels.log_norm(depth, decades=3))
    elif few:
        title, about = f"{title} (▲ positive side, ▼ negative side)", "Approach speed (m/s)"
        for sign, marker, shift in ((1, "^", 0.13), (-1, "v", -0.13)):
            at = side == sign
            image = raster.scatter(onset[at], site[at] + shift, 14, speed[at], marker=marker, lw=0, rasterized=True,
                                   **colours)  # fmt: skip
        raster.grid(axis="y", color=style.PALE, lw=0.5)
        raster.set_axisbelow(True)
    else:
        block = -(-len(sites) // ROWS_OF_A_MAP)
        largest = np.full((-(-len(sites) // block), COLUMNS_OF_A_MAP), np.nan)
        column = np.minimum((onset - span[0]) / (span[1] - span[0]) * COLUMNS_OF_A_MAP, COLUMNS_OF_A_MAP - 1).astype(
            int
        )
        np.fmax.at(largest, (index // block, column), speed)
        image = raster.imshow(largest, extent=(*span, 0.5, 0.5 + block * len(largest)), **colours)
    shown = number[:: 1 if few else -(-len(sites) // 12)]
    raster.set_yticks(shown, [f"{c}" for c in sites[shown - 1]])
    raster.set(title=title, xlabel="Time (s)", ylabel="Contact site (cell)", xlim=span)
    raster.set_ylim(0.4, len(sites) + 0.6)
    panels.colour_bar(image, raster, about)

    loss, episodes = np.bincount(index, np.nan_to_num(lost), len(sites)), np.bincount(index, minlength=len(sites))
    lengths: np.ndarray = loss
    title, label = "(b) Loss" + ", episodes" * few, "Energy lost (J)"
    if not loss.any():
        title, label, lengths = "(b) Episodes", "Episodes", episodes
    if lasting:
        title, label, lengths = "(b) Largest force", "Force (N)", np.zeros(len(sites))
        np.fmax.at(lengths, index, np.abs(run["impacts/force"].values))
    row = bars.barh(number, lengths, 0.6 if few else 1.0, color=style.VERMILION if loss.any() else style.BLUE)
    if few:
        bars.bar_label(row, episodes, padding=2)
    bars.set(title=title, xlabel=label, xlim=(0, (1.25 if few else 1.05) * lengths.max()))
    bars.tick_params(left=False)
    return figure


def ledger(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Energies over time, and below them the residual relative to the work done, on a log scale."""
    time = run["time"].values
    names = "kinetic", "spring", "contact", "work", "dissipated"
    kinetic, spring, contact, work, dissipated = (run[f"energy/{name}"] for name in names)
    damped = run.get("energy/dissipated_by_damping", 0.0 * work)
    largest = float(np.abs(work).max())
    if len(time) < 2 or largest == 0:
        return empty_figure("Energy ledger: the drive has done no work")
    figure = style.new_figure(style.COLUMN, 3.3)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    # Both swing at twice the drive's frequency, which no page can resolve; means over two periods can be seen.
    window = min(int(np.ceil(4 * np.pi / Case.of(run).model().drive.frequency / (time[1] - time[0]))), len(time))
    means = run[["energy/kinetic", "energy/spring"]].rolling(time=window, center=True, min_periods=1).mean()
    stored = kinetic + spring + contact
    curves = (
        ("initial energy and work" if Case.of(run).initial else "work of the drive", work, style.BLACK, "-"),
        ("kinetic + potential", stored, style.BLUE, "-"),
        ("dissipated", dissipated, style.VERMILION, "-"),
        ("kinetic, mean", means["energy/kinetic"], style.SKY, "-"),
        ("springs, mean", means["energy/spring"], style.GREEN, (0, (3, 1.5))),
        ("contacts", contact, style.PURPLE, "-"),
        *([("dissipated in dashpots", damped, style.ORANGE, "-")] if "energy/dissipated_by_damping" in run else []),
    )
    for label, energy, colour, dashes in curves:
        upper.plot(time, energy, color=colour, ls=dashes, label=label, lw=0.9)
    upper.set(ylabel="Energy", xlim=time[[0, -1]], ylim=(-0.03 * largest, 1.4 * largest))
    upper.yaxis.set_major_formatter(EngFormatter("J"))
    upper.legend(loc="upper center", ncol=2, columnspacing=1.2, labelspacing=0.25)

    residual = np.abs(work - dissipated - damped - stored) / largest
    told = run.attrs.get("statistics", {})  # text in a file
    if (json.loads(told) if isinstance(told, str) else told).get("ledger_error", 0.0) is None:
        residual *= np.nan
        panels.note(lower, "none: dashpots have what the balance leaves", (0.5, 0.3), (0, 0), xycoords="axes fraction",
                    ha="center")  # fmt: skip
    lower.semilogy(time, np.maximum(residual, 1e-18), color=style.BLACK, lw=0.5)
    lower.axhline(LARGEST_RESIDUAL, color=style.VERMILION, lw=0.7, ls=style.DASHED)
    panels.note(lower, "limit 1e-8", (0.99, LARGEST_RESIDUAL), (0, 1.5), xycoords=("axes fraction", "data"),
                ha="right", va="bottom", color=style.VERMILION)  # fmt: skip
    lower.locator_params(axis="x", nbins=5)
    lower.set(xlabel="Time (s)", ylabel="|Residual| / work", ylim=(1e-15, np.fmax(1e-6, 10 * float(residual.max()))))
    return figure


def phase(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Velocity against displacement at the first site: grey before the first contact, then by time."""
    site = leading_site(run)
    if site is None:
        return empty_figure("Phase portraits: the lattice has no contact sites")
    cell, gaps = int(run["sites/cell"][site]), [1e3 * float(run["sites/clearance"][site])] * 2
    if "sites/clearance_minus" in run:
        gaps[1] = 1e3 * float(run["sites/clearance_minus"][site])
    if cell not in run["cell"].values:
        return empty_figure(f"Phase portraits: cell {cell}, the first site, was not recorded")
    if "displacement" not in run or "velocity" not in run:
        return empty_figure("Phase portraits: they need displacement and velocity, and one was not recorded")
    chain, motion = Case.of(run).model().chain, run.sel(cell=cell)
    if chain.pairs:
        return empty_figure("Phase portraits are of the cell's pair, and the contacts join others")
    pair = chain.cell
    u, v, time = refined(motion["displacement"].values, motion["velocity"].values, field_time(run))
    onsets = run["impacts/onset"].values[run["impacts/site"].values == site + 1]
    before = int(np.searchsorted(time, onsets.min(initial=np.inf)))

    figure = style.new_figure(style.PAGE, 2.4)
    grid = figure.subplots(1, 3)
    h, r = pair.host, pair.resonator
    portraits = (
        (u[:, h], v[:, h], "(a) Host", "u_h"),
        (u[:, r], v[:, r], "(b) Resonator", "u_r"),
        (u[:, r] - u[:, h], v[:, r] - v[:, h], "(c) Relative motion", "w"),
    )
    for axes, (x, y, title, symbol) in zip(grid, portraits, strict=True):
        points = np.stack([1e3 * x, y], axis=1)
        segments = list(np.stack([points[:-1], points[1:]], axis=1)[before:])
        after = LineCollection(segments, array=time[before:-1], cmap="viridis", lw=0.4, rasterized=True)
        axes.add_collection(after)
        axes.plot(*points[: before + 1].T, color=style.GREY, lw=0.4, rasterized=True)
        centre_axes(axes, points[:, 0], points[:, 1])
        axes.set(title=f"{title}, cell {cell}", xlabel=f"${symbol}$ (mm)", ylabel=rf"$\dot{{{symbol}}}$ (m/s)")
    stops = [side * gap for side, gap in zip((1, -1), gaps, strict=True) if np.isfinite(gap)]
    wide = max(axes.get_xlim()[1], *(1.15 * abs(stop) for stop in stops))
    axes.set_xlim(-wide, wide)
    axes.vlines(stops, *axes.get_ylim(), color=style.VERMILION, lw=0.8, ls=style.DASHED)
    panels.note(axes, "clearance", (stops[0], 1), (-2, -2), xycoords=("data", "axes fraction"), ha="right", va="top",
                color=style.VERMILION)  # fmt: skip
    if len(onsets):
        panels.colour_bar(after, grid, "Time (s)", extend="neither")
    else:
        axes.text(0.5, 0.03, "no contact", ha="center", color=style.GREY, transform=axes.transAxes)
    return figure


def refined(u: np.ndarray, v: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Displacement, velocity and time on a finer grid, so that fast turns at the stops are not polygons."""
    if len(time) < 2:
        return u, v, time
    fine = np.interp(np.arange((len(time) - 1) * REFINE + 1) / REFINE, np.arange(len(time)), time)
    return CubicHermiteSpline(time, u, v, axis=0)(fine), Akima1DInterpolator(time, v)(fine), fine


def centre_axes(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Limits symmetric about zero that hold ``x`` and ``y`` with a margin."""
    for set_limits, values in ((axes.set_xlim, x), (axes.set_ylim, y)):
        reach = 1.07 * np.abs(values).max() or 1.0
        set_limits(-reach, reach)


def bands(cell: UnitCell, frequency: float | None = None) -> Figure:
    """Frequency against wavenumber and against group velocity; gaps shaded, a drive ``frequency`` (rad/s) marked.

    Of a damped cell also against the decay along the lattice of the wave that goes farthest.
    """
    point, passing = bloch(cell, np.linspace(0, np.pi, 361)), pass_bands(cell)
    figure = style.new_figure(style.PAGE * (0.95 if cell.is_damped else 0.72), 3.0)
    widths = [1.3, 1, 1][: 2 + cell.is_damped]
    left, right, *decay = figure.subplots(1, len(widths), sharey=True, width_ratios=widths)
    panels.band_diagram(left, cell, frequency)
    right.plot(point.group_velocity, point.frequency / 1e3)
    for axes in decay:
        omega = np.linspace(0, 1.08 * passing[-1].high, 541)[1:]
        axes.semilogx([1 / decay_length(cell, w) for w in omega.tolist()], omega / 1e3, color=style.BLACK)
        axes.set(title="(c) Decay along the lattice", xlabel="|Im κ| (1/cell)")
    for axes in (right, *decay):
        panels.shade_bands(axes, gaps(passing))
        if frequency is not None:
            axes.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    right.axvline(0, color=style.GREY, lw=0.5)
    for i, band in enumerate(passing):
        panels.note(left, f"{band.number}", (1, (band.low + band.high) / 2e3), (3, 0), va="center", color=f"C{i}")
    left.set_title("(a) Bands; gaps shaded")
    right.set(title="(b) Group velocity", xlabel="Group velocity dω/dκ (cells/s)")
    return figure
