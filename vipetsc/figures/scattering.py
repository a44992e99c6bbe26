"""Wavenumber scattering at three amplitudes: energy, wavelets, entropy, wavenumber bins (Figs. 2-4, A1, A2, S1)."""

import itertools

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from scipy.ndimage import gaussian_filter

from vipetsc.figures import panels, style
from vipetsc.figures.panels import ROMAN
from vipetsc.figures.sweep_members import AmplitudeSeries, SweepMember, from_series
from vipetsc.io.read import field_time
from vipetsc.lattice import bloch, pass_bands
from vipetsc.spectra import Nodes, inverse, transform

KC, NODES = 12.0, 120  # the wavelets of the entropy, on a grid twice as fine
BINS_KC = 6.0  # the wavelets of the bins
SHOWN, EXPLAINED = 7, 4  # bins whose maps are drawn
BINS_DECADES = 4
LEVEL = 0.003  # of the largest energy of any bin: where the contours lie
FIELD = "partition/kinetic_energy"  # (bin, snapshot, cell)
BLUR = 0.006, 0.01  # of all snapshots and cells: the carrier's beat is smoothed out before contours are drawn
LEAST_WEIGHT = 1e-5  # of the largest: cells with less energy have no entropy
ROWS = {
    "kinetic_energy": "Energy of a cell",
    "wavenumber_content": "Energy of a wavenumber",
    "dispersion": "Mean energy of a bin",
}
MOMENTS = ("Before the first site", "At the first site", "Past the last site", "Near the end")


@from_series(*ROWS)
def amplitudes(series: AmplitudeSeries) -> Figure:
    """Three amplitudes by (space-time kinetic energy, wavenumber content, dispersion); paper, Fig. 2.

    Energies are divided by the square of the amplitude: one scale serves a row, and what differs between its
    panels is nonlinear.
    """
    figure, grid = series.page(3, 6.4, sharey="row")
    for row, (name, label) in zip(grid, ROWS.items(), strict=True):
        fields = [member.analysis[name].load() / member.case.drive.amplitude**2 for member in series.runs]
        norm = panels.log_norm(*fields)
        for axes, field, member in zip(row, fields, series.runs, strict=True):
            if name == "kinetic_energy":
                image = panels.space_time_map(axes, field, norm, member.run)
            elif name == "wavenumber_content":
                image = panels.content_map(axes, field, norm)
                axes.plot(0.015, series.wave.wavenumber / np.pi, ">", color=style.SKY, mec="white", mew=0.3, ms=4,
                          transform=axes.get_yaxis_transform())  # fmt: skip
            else:
                image = panels.dispersion_map(axes, field, norm, member.model.chain.cell)
                axes.set_ylim(0, 1.1e-3 * pass_bands(member.model.chain.cell)[-1].high)
        panels.colour_bar(image, row, f"{label} / A² (J/N²)")
    for axes in grid[:, 1:].flat:
        axes.set_ylabel("")
    return figure


@from_series(wave=True, sites=True)
def wavelets(series: AmplitudeSeries) -> Figure:
    """|X(kappa, x)| of the host velocity at four times for three amplitudes, over the amplitude; paper, Fig. 3.

    A black line marks the wavenumber of the linear wave at the drive's frequency.
    """
    kappa = np.pi * np.arange(1, NODES + 1) / NODES
    transforms = []  # times and values (time, wavenumber, cell) of each run
    for member in series.runs:
        time = field_time(member.run)
        samples = [int(np.argmin(np.abs(time - t))) for t in series.snapshot_times()]
        host = member.run["velocity"][samples, :, member.model.chain.cell.host].values
        values = np.abs(transform(host, kappa, KC)[..., : host.shape[-1]]) / abs(member.case.drive.amplitude)
        transforms.append((time[samples], values))
    norm = panels.log_norm(*(values for _, values in transforms), decades=2.5)

    figure, grid = series.page(4, 6.6, sharex=True, sharey=True)
    for row, moment in enumerate(MOMENTS):
        for axes, (time, values), member in zip(grid[row], transforms, series.runs, strict=True):
            image = panels.draw_map(axes, member.run["cell"].values, kappa / np.pi, values[row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            panels.mark_sites(axes, member.run, style.GREY, "x")
            axes.text(0.97, 0.94, f"t = {time[row]:.3g} s", transform=axes.transAxes, ha="right", va="top",
                      bbox={"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0})  # fmt: skip
        grid[row, 0].set(ylabel=f"{moment}\nκ (π rad/cell)", ylim=(0, 1))
    figure.supxlabel("Cell")
    panels.colour_bar(image, grid, "Wavelet transform |X| / A (m/s/N)", aspect=50)
    return figure


@from_series("entropy/local")
def entropy_maps(series: AmplitudeSeries) -> Figure:
    """H(x, t) at three amplitudes to one scale, with the energy-weighted H(t) over each; paper, Fig. A2.

    Cells are blank where they have hardly any energy: only the wavelets' tails are there.
    """
    fields = []
    for member in series.runs:
        weight = member.analysis["entropy/weight"]
        fields.append(member.analysis["entropy/local"].where(weight > LEAST_WEIGHT * weight.max()))
    norm = panels.percentile_norm(fields)
    figure, grid = series.page(1, 2.7, sharey=True)
    for axes, field, member in zip(grid[0], fields, series.runs, strict=True):
        time, history = (member.analysis[f"entropy/{name}"].values for name in ("snapshot", "history"))
        image = panels.space_time_map(axes, field, norm)
        image.set_cmap("viridis")
        panels.mark_sites(axes, member.run, style.GREY)
        axes.label_outer()
        # The line shares the colours' limits, so that the colour bar is its axis too.
        over = axes.twinx()
        over.plot(time, history, color="white", lw=2.0)
        over.plot(time, history, color=style.VERMILION, lw=0.9, label="H(t)")
        over.axvline(member.analysis.attrs["entropy/start"], color=style.BLACK, lw=0.7, ls="--", label="averages begin")
        over.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]], yticks=[])
    over.legend(loc="upper left")
    panels.colour_bar(image, grid, "H(x, t) and line: H(t) (bit)", extend="both")
    return figure


def bin_colours(count: int) -> np.ndarray:
    """Colours (bin, rgba) in the order of the spectrum, dark enough for lines."""
    return mpl.colormaps["turbo"](np.linspace(0.04, 0.96, count)) * (0.85, 0.85, 0.85, 1.0)


def shown_bins(wavenumber: float, count: int, shown: int = SHOWN) -> list[int]:
    """``shown`` of ``count`` bins (0-based), spread evenly, the bin of ``wavenumber`` and the nearer neighbour in it.

    At 5 pi/9 these are bins 1, 3, 5, 7, 8, 10 and 12 of twelve.
    """
    position = wavenumber * count / np.pi
    driven = min(int(position), count - 1)
    above = driven + 1 < count and (position - driven >= 0.5 or driven == 0)
    pair = driven, driven + 1 if above else driven - 1
    bins = [round(b) for b in np.linspace(0, count - 1, min(shown, count))]
    for b in pair:
        if b not in bins:
            bins[min((i for i, c in enumerate(bins) if c not in pair), key=lambda i: abs(bins[i] - b))] = b
    return sorted(bins)


@from_series(FIELD, wave=True)
def partition(series: AmplitudeSeries) -> Figure:
    """Energy of seven bins in space-time at the medium amplitude, contours of all, the driven band (paper, Fig. 4)."""
    medium, wave = series.runs[1], series.wave
    field = medium.analysis[FIELD].load()
    bins, colours = shown_bins(wave.wavenumber, len(field)), bin_colours(len(field))
    norm = panels.log_norm(field[bins], decades=BINS_DECADES)
    figure = style.new_figure(style.PAGE, 6.6, f"{series.title}; maps at {medium.case.drive.amplitude:g} N")
    upper, lower = figure.subfigures(2, 1, height_ratios=(2, 1.1))
    grid = upper.subplots(2, 4)
    *maps, band = grid.flat
    for axes, b, roman in zip(maps, bins, ROMAN, strict=False):
        image = panels.space_time_map(axes, field[b], norm, medium.run)
        axes.set(title=f"(a.{roman}) $K_{{{b + 1}}}$", ylabel="Cell" if axes in grid[:, 0] else "")
        axes.tick_params(labelleft=axes in grid[:, 0])
    for axes in maps[len(bins) :]:
        axes.set_axis_off()
    panels.colour_bar(image, grid, "Energy of a bin in a cell (J)", aspect=40)

    for ends, colour in zip(itertools.pairwise(medium.analysis["partition/bounds"].values), colours, strict=True):
        kappa = np.linspace(*ends, 31)
        branch = bloch(medium.model.chain.cell, kappa).frequency[:, wave.band - 1]
        band.plot(kappa / np.pi, branch / 1e3, color=colour, lw=3, solid_capstyle="butt")
    band.axvline(wave.wavenumber / np.pi, color=style.BLACK, lw=0.6, ls=":")
    band.set(title=f"(c) Band {wave.band} by bin", xlabel="κ (π rad/cell)", ylabel="ω (krad/s)", xlim=(0, 1))

    contours = lower.subplots(1, 3, sharey=True)
    for axes, roman, heading, member in zip(contours, ROMAN, series.headings, series.runs, strict=False):
        _contours(axes, member, colours)
        axes.set(title=f"(b.{roman}) {heading}", xlabel="Time (s)")
    contours[0].set_ylabel("Cell")
    number = np.arange(1, len(colours) + 1)
    keys = mpl.cm.ScalarMappable(BoundaryNorm(np.append(0, number) + 0.5, len(colours)), ListedColormap(colours))
    panels.colour_bar(keys, contours, "Bin", ticks=number, extend="neither")
    return figure


def _contours(axes: Axes, member: SweepMember, colours: np.ndarray) -> None:
    """Every bin where its energy exceeds ``LEVEL`` of the largest of any, filled and outlined in its colour."""
    field, cells, time = (member.analysis[name].values for name in (FIELD, "cell", "partition/snapshot"))
    step = max(1, len(cells) // 300)
    widths = np.multiply(BLUR, field.shape[1:])
    smooth = [gaussian_filter(energy, widths, mode="nearest")[:, ::step] for energy in field]
    level = LEVEL * max(float(energy.max()) for energy in smooth)
    # The strongest lie beneath, so that what is scattered out of them is seen.
    for b in sorted(range(len(smooth)), key=lambda b: -smooth[b].sum()):
        if smooth[b].max() > level > 0:
            axes.contourf(time, cells[::step], smooth[b].T, [level, np.inf], colors=[colours[b]], alpha=0.35)
            axes.contour(time, cells[::step], smooth[b].T, [level], colors=[colours[b]], linewidths=0.6)
    panels.mark_sites(axes, member.run, style.GREY)
    axes.set(xlim=time[[0, -1]], ylim=cells[[0, -1]])


@from_series("partition/reconstructed")
def reconstruction(series: AmplitudeSeries) -> Figure:
    """Total and reconstructed energy over time, relative error, the share between bins (paper, Fig. A1)."""
    figure, grid = series.page(3, 5.0, sharex="col", sharey="row")
    for (energies, errors, shares), member in zip(grid.T, series.runs, strict=True):
        names = "snapshot", "kinetic", "reconstructed", "error", "cross_share", "energy"
        time, kinetic, reconstructed, error, cross, parts = (member.analysis[f"partition/{n}"].values for n in names)
        square = member.case.drive.amplitude**2
        energies.plot(time, kinetic / square, color=style.BLACK, lw=1.4, label="KE of the lattice")
        energies.plot(time, reconstructed / square, color=style.ORANGE, lw=0.8, ls="--", label="KE of the bins' sum")
        energies.plot(time, parts.sum(axis=0) / square, color=style.BLUE, lw=0.7, label="sum of the twelve KE")
        errors.semilogy(time, np.where(error > 0, error, np.nan), lw=0.7)
        errors.axhline(0.01, color=style.VERMILION, lw=0.8, ls="--")
        shares.plot(time, cross, color=style.GREEN, lw=0.8)
        shares.set(ylim=(0, 1), xlabel="Time (s)", xlim=time[[0, -1]])
        shares.locator_params(axis="x", nbins=5)
    grid[0, 0].set(ylabel="Kinetic energy / A² (J/N²)", ylim=(0, None))
    grid[0, 0].legend(loc="upper left")
    grid[1, 0].set(ylabel="Relative error")
    panels.note(grid[1, 0], "1 %", (1, 0.01), (-2, -2), xycoords=("axes fraction", "data"), ha="right", va="top")
    grid[2, 0].set(ylabel="Share of KE between bins")
    return figure


@from_series(FIELD, wave=True, sites=True)
def partition_explained(series: AmplitudeSeries) -> Figure:
    """A snapshot, its wavelet transform cut into bins, the inverse of some, their energy in space-time (Fig. S1)."""
    member = series.runs[1]
    field = member.analysis[FIELD].load()
    cells = member.run["cell"].values
    snapshots, bounds = (member.analysis[f"partition/{name}"].values for name in ("snapshot", "bounds"))
    time = float(snapshots[np.argmin(np.abs(snapshots - series.snapshot_times()[2]))])
    sample = int(np.argmin(np.abs(field_time(member.run) - time)))
    signal = member.run["velocity"][sample, :, member.model.chain.cell.host].values
    nodes = Nodes.log(BINS_KC)
    transformed = transform(signal, nodes.kappa, BINS_KC)
    parts = inverse(transformed, nodes, BINS_KC)[:, : len(cells)]
    bins, colours = shown_bins(series.wave.wavenumber, len(field), EXPLAINED), bin_colours(len(field))

    figure = style.new_figure(style.PAGE, 4.6, f"{series.title}; {member.case.drive.amplitude:g} N")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.8), wspace=0.1)  # apart, for the arrows
    above, below = left.subplots(2, 1, sharex=True)
    above.plot(cells, signal, color=style.BLACK, lw=0.4)
    above.set(title=f"(a) Snapshot at t = {time:.3g} s", ylabel="Host velocity (m/s)", xlim=cells[[0, -1]])
    _domain(below, cells, transformed[:, : len(cells)], nodes, bounds)
    largest, norm = 1.1 * np.abs(parts[bins]).max(), panels.log_norm(field[bins], decades=BINS_DECADES)
    grid = right.subplots(EXPLAINED, 2, sharex="col", sharey="col")
    # Bins rise upwards, as in the wavelet domain.
    for roman, b, (trace, energy) in zip(ROMAN, reversed(bins), grid, strict=False):
        trace.plot(cells, parts[b], color=colours[b], lw=0.5)
        trace.set(title=f"(c.{roman}) Velocity (m/s) of $K_{{{b + 1}}}$", xlim=cells[[0, -1]], ylim=(-largest, largest))
        trace.yaxis.tick_right()
        image = panels.space_time_map(energy, field[b], norm, member.run)
        energy.axvline(time, color="white", lw=0.6)
        energy.set(title=f"(d.{roman}) Energy of $K_{{{b + 1}}}$", xlabel="")
        middle = float(np.clip(0.5 * (bounds[b] + bounds[b + 1]), nodes.kappa[0], np.pi)) / np.pi
        ends = (1.0, middle), (0.0, 0.5), below.get_yaxis_transform(), trace.transAxes
        right.add_artist(ConnectionPatch(*ends, arrowstyle="-|>", color=colours[b], lw=0.7, mutation_scale=6))
    grid[-1, 0].set_xlabel("Cell")
    grid[-1, 1].set_xlabel("Time (s)")
    panels.colour_bar(image, grid[:, 1], "Energy of a bin in a cell (J)", aspect=40)
    return figure


def _domain(axes: Axes, cells: np.ndarray, x: np.ndarray, nodes: Nodes, bounds: np.ndarray) -> None:
    """|X| over cells and wavenumber with the bounds of the bins, each named on the right edge."""
    inside = nodes.kappa <= np.pi
    kappa, magnitude = nodes.kappa[inside] / np.pi, np.abs(x[inside])
    colours = {"norm": panels.log_norm(magnitude, decades=2), "cmap": "magma_r", "rasterized": True}
    axes.pcolormesh(cells, kappa, magnitude, shading="nearest", **colours)
    axes.hlines(bounds[1:-1] / np.pi, *cells[[0, -1]], color=style.GREY, lw=0.4)
    middles = 0.5 * (bounds[:-1] + bounds[1:]) / np.pi
    for b, (middle, colour) in enumerate(zip(middles, bin_colours(len(middles)), strict=True), 1):
        axes.text(0.985, middle, f"{b}", transform=axes.get_yaxis_transform(), ha="right", va="center",
                  fontsize=5.5, fontweight="bold", color=colour)  # fmt: skip
    axes.set(title="(b) Wavelets |X| and bins", xlabel="Cell", ylabel="κ (π rad/cell)", ylim=(0, 1))
