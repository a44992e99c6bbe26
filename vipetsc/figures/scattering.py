"""Wavenumber scattering at three amplitudes: energy, wavelets, entropy, wavenumber bins.

A sweep over the amplitude A of the drive has a run at its lowest, middle and highest amplitude in each figure. In a
linear lattice energies grow as A^2 and velocities as A: over these, what differs between the panels is nonlinear.

X(kappa, x) is the Morlet wavelet transform in space of the velocity of the cells' host masses (``spectra.wavelet``);
H(x, t) the local entropy of |X|^2 over the wavenumbers kappa and H(t) its energy-weighted mean (``spectra.entropies``);
the bins K_1, K_2, ... are equal parts of the wavenumbers from 0 to pi, into which the velocity is divided by an inverse
transform of the nodes of each. "Paper, Fig. n" is a figure of Phys. Rev. E 108, 044214 (2023).
"""

from itertools import pairwise
from typing import NamedTuple, Self

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch
from scipy.ndimage import gaussian_filter

from vipetsc.figures import panels, style
from vipetsc.figures.panels import ROMAN
from vipetsc.figures.sweep_members import AmplitudeSeries, MemberRun, from_series
from vipetsc.io.read import field_time
from vipetsc.lattice import bloch, pass_bands
from vipetsc.spectra import Nodes, inverse, transform

# Centre wavenumbers of the wavelets, both the paper's: a larger one tells wavenumbers apart, as entropies need it, a
# smaller one positions, as the maps of bins do.
KC = 12.0
BINS_KC = 6.0
# Wavenumbers in a map of |X|: twice those of the entropy, whose rows would be seen as steps.
WAVENUMBERS = 120
SHOWN = 7  # bins whose maps are drawn
EXPLAINED = 4  # bins in the picture that explains them
# Decades below the largest value that a colour scale shows: of |X| over all panels, of |X| next to its bins, where two
# tell the packets from their tails, and of the energy of bins, which differ by more.
WAVELET_DECADES = 2.5
DOMAIN_DECADES = 2
BINS_DECADES = 4
# Contours of a bin's energy, as a fraction of the largest of any bin: there they enclose packets and not their tails.
LEVEL = 0.003
FIELD = "partition/kinetic_energy"  # (bin, snapshot, cell)
# Standard deviations of the smoothing before contours are drawn, as fractions of the number of snapshots and of cells:
# longer than the beat of the carrier wave, shorter than a packet.
BLUR = 0.006, 0.01
LEAST_WEIGHT = 1e-5  # of the largest: cells with less energy have no entropy
# The relative error up to which the paper takes its partition to be complete (its Eq. (A8)).
COMPLETE = 0.01
ROWS = {
    "kinetic_energy": "Energy of a cell",
    "wavenumber_content": "Energy of a wavenumber",
    "dispersion": "Mean energy of a bin",
}
# The times of ``AmplitudeSeries.snapshot_times``, in their order.
MOMENTS = ("Before the first site", "At the first site", "Past the last site", "Near the end")


@from_series(*ROWS)
def amplitudes(series: AmplitudeSeries) -> Figure:
    """Draw three amplitudes by (space-time kinetic energy, wavenumber content, dispersion); paper, Fig. 2.

    Energies are divided by the square of the amplitude, so that one scale serves a row.
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
                look = {"color": style.SKY, "mec": "white", "mew": 0.3, "ms": 4}
                driven = series.wave.wavenumber / np.pi
                axes.plot(0.015, driven, ">", transform=axes.get_yaxis_transform(), **look)
            else:
                cell = member.model.chain.cell
                image = panels.dispersion_map(axes, field, norm, cell)
                # In krad/s, with a tenth more than the highest pass band.
                axes.set_ylim(0, 1.1e-3 * pass_bands(cell)[-1].high)
        panels.colour_bar(image, row, f"{label} / A² (J/N²)")

    for axes in grid[:, 1:].flat:
        axes.set_ylabel("")
    return figure


class Wavelets(NamedTuple):
    """|X| of the host velocity over the drive's amplitude, ``values`` (time, wavenumber, cell), at ``time`` in s."""

    time: np.ndarray
    values: np.ndarray


@from_series(wave=True, sites=True)
def wavelets(series: AmplitudeSeries) -> Figure:
    """Draw |X(kappa, x)| of the host velocity at four times for three amplitudes, over the amplitude; paper, Fig. 3.

    A black line marks the wavenumber of the linear wave at the drive's frequency.
    """
    kappa = np.pi * np.arange(1, WAVENUMBERS + 1) / WAVENUMBERS
    times = series.snapshot_times()
    transforms = [_wavelets(member, times, kappa) for member in series.runs]
    norm = panels.log_norm(*(transformed.values for transformed in transforms), decades=WAVELET_DECADES)

    figure, grid = series.page(4, 6.6, sharex=True, sharey=True)
    for row, moment in enumerate(MOMENTS):
        for axes, transformed, member in zip(grid[row], transforms, series.runs, strict=True):
            cells = member.run["cell"].values
            image = panels.draw_map(axes, cells, kappa / np.pi, transformed.values[row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            panels.mark_sites(axes, member.run, style.GREY, "x")
            box = {"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0}
            text = f"t = {transformed.time[row]:.3g} s"
            axes.text(0.97, 0.94, text, transform=axes.transAxes, ha="right", va="top", bbox=box)
        grid[row, 0].set(ylabel=f"{moment}\nκ (π rad/cell)", ylim=(0, 1))

    figure.supxlabel("Cell")
    panels.colour_bar(image, grid, "Wavelet transform |X| / A (m/s/N)", aspect=50)
    return figure


def _wavelets(member: MemberRun, times: np.ndarray, kappa: np.ndarray) -> Wavelets:
    """Return the transforms of the samples nearest to ``times`` (s) at the wavenumbers ``kappa``, in rad per cell."""
    time = field_time(member.run)
    samples = [int(np.argmin(np.abs(time - t))) for t in times]
    # The velocity is that of (time, cell, mass of the cell); the transform is padded beyond the last cell.
    host = member.run["velocity"][samples, :, member.model.chain.cell.host].values
    magnitude = np.abs(transform(host, kappa, KC)[..., : host.shape[-1]])
    return Wavelets(time=time[samples], values=magnitude / abs(member.case.drive.amplitude))


@from_series("entropy/local")
def entropy_maps(series: AmplitudeSeries) -> Figure:
    """Draw H(x, t) at three amplitudes to one scale, with the energy-weighted H(t) over each; paper, Fig. A2.

    A dashed line marks the time from which averages of H are taken, that of the linear wave's arrival. Cells are blank
    where they have hardly any energy: only the wavelets' tails are there.
    """
    fields = []
    for member in series.runs:
        weight = member.analysis["entropy/weight"]
        fields.append(member.analysis["entropy/local"].where(weight > LEAST_WEIGHT * weight.max()))
    norm = panels.percentile_norm(fields)

    figure, grid = series.page(1, 2.7, sharey=True)
    for axes, field, member in zip(grid[0], fields, series.runs, strict=True):
        image = panels.space_time_map(axes, field, norm)
        image.set_cmap("viridis")
        panels.mark_sites(axes, member.run, style.GREY)
        axes.label_outer()

        # The line has the limits of the colours, so that the colour bar is its axis too.
        over = axes.twinx()
        time = member.analysis["entropy/snapshot"].values
        history = member.analysis["entropy/history"].values
        start = member.analysis.attrs["entropy/start"]
        over.plot(time, history, color="white", lw=2.0)
        over.plot(time, history, color=style.VERMILION, lw=0.9, label="H(t)")
        over.axvline(start, color=style.BLACK, lw=0.7, ls="--", label="averages begin")
        over.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]], yticks=[])
    over.legend(loc="upper left")
    panels.colour_bar(image, grid, "H(x, t) and line: H(t) (bit)", extend="both")
    return figure


def bin_colours(count: int) -> np.ndarray:
    """Return colours (bin, rgba) in the order of the spectrum, dark enough for lines."""
    return mpl.colormaps["turbo"](np.linspace(0.04, 0.96, count)) * (0.85, 0.85, 0.85, 1.0)


def shown_bins(wavenumber: float, count: int, shown: int = SHOWN) -> list[int]:
    """Return ``shown`` of ``count`` bins (0-based), spread evenly, with that of ``wavenumber`` and its neighbour.

    At 5 pi/9 these are bins 1, 3, 5, 7, 8, 10 and 12 of twelve.
    """
    position = wavenumber * count / np.pi
    driven = min(int(position), count - 1)
    above = driven + 1 < count and (position - driven >= 0.5 or driven == 0)
    # The neighbour on the side of the wavenumber: the packet, which has a width, reaches over into it.
    pair = driven, driven - 1
    if above:
        pair = driven, driven + 1

    # Evenly spread bins may lack one bin of the pair, or both. Each of these replaces the nearest bin of the others.
    bins = [round(number) for number in np.linspace(0, count - 1, min(shown, count))]
    for wanted in pair:
        if wanted not in bins:
            others = [i for i, number in enumerate(bins) if number not in pair]
            nearest = min(others, key=lambda i: abs(bins[i] - wanted))
            bins[nearest] = wanted
    return sorted(bins)


@from_series(FIELD, wave=True)
def partition(series: AmplitudeSeries) -> Figure:
    """Draw some bins in space-time at the medium amplitude, contours of all, the driven band (paper, Fig. 4)."""
    medium = series.runs[1]
    field = medium.analysis[FIELD].load()
    bins = shown_bins(series.wave.wavenumber, len(field))
    colours = bin_colours(len(field))
    norm = panels.log_norm(field[bins], decades=BINS_DECADES)
    figure = style.new_figure(style.PAGE, 6.6, f"{series.title}; maps at {medium.case.drive.amplitude:g} N")
    upper, lower = figure.subfigures(2, 1, height_ratios=(2, 1.1))

    grid = upper.subplots(2, 4)
    *maps, band = grid.flat
    for axes, b, roman in zip(maps, bins, ROMAN, strict=False):
        image = panels.space_time_map(axes, field[b], norm, medium.run)
        is_left = axes in grid[:, 0]
        axes.set(title=f"(a.{roman}) $K_{{{b + 1}}}$", ylabel="Cell" if is_left else "")
        axes.tick_params(labelleft=is_left)
    for axes in maps[len(bins) :]:
        axes.set_axis_off()
    panels.colour_bar(image, grid, "Energy of a bin in a cell (J)", aspect=40)
    _draw_driven_band(band, series, colours)

    contours = lower.subplots(1, 3, sharey=True)
    for axes, roman, heading, member in zip(contours, ROMAN, series.headings, series.runs, strict=False):
        _draw_contours(axes, member, colours)
        axes.set(title=f"(b.{roman}) {heading}", xlabel="Time (s)")
    contours[0].set_ylabel("Cell")
    number = np.arange(1, len(colours) + 1)
    bounds = np.append(0, number) + 0.5
    keys = mpl.cm.ScalarMappable(BoundaryNorm(bounds, len(colours)), ListedColormap(colours))
    panels.colour_bar(keys, contours, "Bin", ticks=number, extend="neither")
    return figure


def _draw_driven_band(axes: Axes, series: AmplitudeSeries, colours: np.ndarray) -> None:
    """Draw the dispersion of the driven band, each bin in its colour, and the driven wavenumber."""
    medium = series.runs[1]
    wave = series.wave
    for ends, colour in zip(pairwise(medium.analysis["partition/bounds"].values), colours, strict=True):
        kappa = np.linspace(*ends, 31)
        frequency = bloch(medium.model.chain.cell, kappa).frequency[:, wave.band - 1]
        axes.plot(kappa / np.pi, frequency / 1e3, color=colour, lw=3, solid_capstyle="butt")
    axes.axvline(wave.wavenumber / np.pi, color=style.BLACK, lw=0.6, ls=":")
    axes.set(title=f"(c) Band {wave.band} by bin", xlabel="κ (π rad/cell)", ylabel="ω (krad/s)", xlim=(0, 1))


def _draw_contours(axes: Axes, member: MemberRun, colours: np.ndarray) -> None:
    """Draw every bin where its energy exceeds ``LEVEL`` of the largest of any, filled and outlined in its colour."""
    field = member.analysis[FIELD].values
    cells = member.analysis["cell"].values
    time = member.analysis["partition/snapshot"].values
    # A panel is 300 pixels high: contours through more rows cost time that nobody sees.
    step = max(1, len(cells) // 300)
    widths = np.multiply(BLUR, field.shape[1:])
    # "nearest": at the edges of the record the energy goes on, and is not reflected.
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
    """Draw total and reconstructed energy over time, relative error, energy between bins (paper, Fig. A1).

    The velocities of the bins add up to that of the lattice, but their energies do not: ``cross_share`` of the analysis
    is the fraction of the kinetic energy (KE) that is in products of the velocities of two bins.
    """
    figure, grid = series.page(3, 5.0, sharex="col", sharey="row")
    for (energies, errors, crosses), member in zip(grid.T, series.runs, strict=True):
        analysis = member.analysis
        time = analysis["partition/snapshot"].values
        kinetic = analysis["partition/kinetic"].values
        reconstructed = analysis["partition/reconstructed"].values
        parts = analysis["partition/energy"].values
        error = analysis["partition/error"].values
        square = member.case.drive.amplitude**2

        energies.plot(time, kinetic / square, color=style.BLACK, lw=1.4, label="KE of the lattice")
        energies.plot(time, reconstructed / square, color=style.ORANGE, lw=0.8, ls="--", label="KE of the bins' sum")
        energies.plot(time, parts.sum(axis=0) / square, color=style.BLUE, lw=0.7, label=f"sum of the {len(parts)} KE")

        # Before the wave comes both energies are 0, and so is their difference.
        errors.semilogy(time, np.where(error > 0, error, np.nan), lw=0.7)
        errors.axhline(COMPLETE, color=style.VERMILION, lw=0.8, ls="--")

        crosses.plot(time, analysis["partition/cross_share"].values, color=style.GREEN, lw=0.8)
        crosses.set(ylim=(0, 1), xlabel="Time (s)", xlim=time[[0, -1]])
        crosses.locator_params(axis="x", nbins=5)

    grid[0, 0].set(ylabel="Kinetic energy / A² (J/N²)", ylim=(0, None))
    grid[0, 0].legend(loc="upper left")
    grid[1, 0].set(ylabel="Relative error")
    limit = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "top"}
    panels.note(grid[1, 0], f"{100 * COMPLETE:g} %", (1, COMPLETE), (-2, -2), **limit)
    grid[2, 0].set(ylabel="Fraction of KE between bins")
    return figure


class Snapshot(NamedTuple):
    """The host velocity (cell) in m/s at ``time`` in s, its transform (wavenumber, cell) and bins (bin, cell)."""

    time: float
    velocity: np.ndarray
    nodes: Nodes
    transformed: np.ndarray
    parts: np.ndarray

    @classmethod
    def nearest(cls, member: MemberRun, wanted: float) -> Self:
        """Return the snapshot of the partition that is nearest to the time ``wanted`` in s."""
        snapshots = member.analysis["partition/snapshot"].values
        time = float(snapshots[np.argmin(np.abs(snapshots - wanted))])
        sample = int(np.argmin(np.abs(field_time(member.run) - time)))
        velocity = member.run["velocity"][sample, :, member.model.chain.cell.host].values

        # These bins are those of the analysis, which has their bounds (``spectra.wavelet.BINS``).
        # The transform is padded; what lies beyond the cells is not shown.
        nodes = Nodes.log(BINS_KC)
        transformed = transform(velocity, nodes.kappa, BINS_KC)
        parts = inverse(transformed, nodes, BINS_KC)
        cells = len(velocity)
        return cls(time, velocity, nodes, transformed[:, :cells], parts[:, :cells])


@from_series(FIELD, wave=True, sites=True)
def partition_explained(series: AmplitudeSeries) -> Figure:
    """Draw a snapshot, its wavelet transform cut into bins, the inverse of some, their energy (paper, Fig. S1)."""
    member = series.runs[1]
    field = member.analysis[FIELD].load()
    cells = member.run["cell"].values
    bounds = member.analysis["partition/bounds"].values
    past_last_site = series.snapshot_times()[MOMENTS.index("Past the last site")]
    snapshot = Snapshot.nearest(member, past_last_site)
    bins = shown_bins(series.wave.wavenumber, len(field), EXPLAINED)
    colours = bin_colours(len(field))

    # The halves are subfigures with a gap between them, which the arrows cross.
    figure = style.new_figure(style.PAGE, 4.6, f"{series.title}; {member.case.drive.amplitude:g} N")
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.8), wspace=0.1)
    above, below = left.subplots(2, 1, sharex=True)
    above.plot(cells, snapshot.velocity, color=style.BLACK, lw=0.4)
    title = f"(a) Snapshot at t = {snapshot.time:.3g} s"
    above.set(title=title, ylabel="Host velocity (m/s)", xlim=cells[[0, -1]])
    _draw_domain(below, cells, snapshot, bounds)

    largest = 1.1 * np.abs(snapshot.parts[bins]).max()
    norm = panels.log_norm(field[bins], decades=BINS_DECADES)
    grid = right.subplots(EXPLAINED, 2, sharex="col", sharey="col")
    # Bins rise upwards, as in the wavelet domain.
    for roman, b, (trace, energy) in zip(ROMAN, reversed(bins), grid, strict=False):
        trace.plot(cells, snapshot.parts[b], color=colours[b], lw=0.5)
        trace.set(title=f"(c.{roman}) Velocity (m/s) of $K_{{{b + 1}}}$", xlim=cells[[0, -1]], ylim=(-largest, largest))
        trace.yaxis.tick_right()

        image = panels.space_time_map(energy, field[b], norm, member.run)
        energy.axvline(snapshot.time, color="white", lw=0.6)
        energy.set(title=f"(d.{roman}) Energy of $K_{{{b + 1}}}$", xlabel="")

        # From the middle of the bin, where the domain shows any of it, to the trace.
        middle = float(np.clip(0.5 * (bounds[b] + bounds[b + 1]), snapshot.nodes.kappa[0], np.pi)) / np.pi
        arrow = ConnectionPatch(
            xyA=(1.0, middle),
            coordsA=below.get_yaxis_transform(),
            xyB=(0.0, 0.5),
            coordsB=trace.transAxes,
            arrowstyle="-|>",
            color=colours[b],
            lw=0.7,
            mutation_scale=6,
        )
        right.add_artist(arrow)

    grid[-1, 0].set_xlabel("Cell")
    grid[-1, 1].set_xlabel("Time (s)")
    panels.colour_bar(image, grid[:, 1], "Energy of a bin in a cell (J)", aspect=40)
    return figure


def _draw_domain(axes: Axes, cells: np.ndarray, snapshot: Snapshot, bounds: np.ndarray) -> None:
    """Draw |X| over cells and wavenumber with the ``bounds`` of the bins, each named on the right edge."""
    inside = snapshot.nodes.kappa <= np.pi
    kappa = snapshot.nodes.kappa[inside] / np.pi
    magnitude = np.abs(snapshot.transformed[inside])
    norm = panels.log_norm(magnitude, decades=DOMAIN_DECADES)
    axes.pcolormesh(cells, kappa, magnitude, shading="nearest", norm=norm, cmap="magma_r", rasterized=True)
    axes.hlines(bounds[1:-1] / np.pi, *cells[[0, -1]], color=style.GREY, lw=0.4)

    middles = 0.5 * (bounds[:-1] + bounds[1:]) / np.pi
    for number, (middle, colour) in enumerate(zip(middles, bin_colours(len(middles)), strict=True), 1):
        text = {"ha": "right", "va": "center", "fontsize": 5.5, "fontweight": "bold", "color": colour}
        axes.text(0.985, middle, f"{number}", transform=axes.get_yaxis_transform(), **text)
    axes.set(title="(b) Wavelets |X| and bins", xlabel="Cell", ylabel="κ (π rad/cell)", ylim=(0, 1))
