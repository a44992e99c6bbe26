"""Wavenumber bins at three amplitudes: energies of the bins in space and time, and how they are made.

As in ``vipetsc.figures.scattering``, a sweep over the amplitude A of the drive has a run at its lowest, medium and
highest amplitude in each figure; the *driven wavenumber* is that of the linear wave at the drive's frequency.

The *bins* K_1, K_2, ... are equal parts of the wavenumbers from 0 to pi. The velocity v(x) of the masses of one kind,
one in each cell x, has the Morlet wavelet transform X(kappa, x) of ``vipetsc.figures.scattering``. Of the nodes kappa
those that lie in a bin b are inverted alone, which gives the bin's part v_b of the velocity. Nodes above pi, whose
wavelets reach below pi, belong to the last bin. That amounts to a filter over the wavenumbers eta,

    T_b(eta) = (1/C) sum over the nodes kappa of b of (dkappa/kappa) exp[-(kc eta/kappa - kc)^2],

with the constant C by which the sum over all nodes of an endless grid is 1 at every eta > 0
(``vipetsc.spectra.wavelet``). All parts together are the velocity, but for its mean and the longest waves, which the
nodes do not reach. The energies of bins are those of all masses of a cell; the picture that explains them shows the
velocity of the hosts. "Paper, Fig. n" is a figure of Phys. Rev. E 108, 044214 (2023).
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

from vipetsc.case.amplitude import drive_unit
from vipetsc.figures import panels, style
from vipetsc.figures.page import add_letters
from vipetsc.figures.scattering import MOMENTS
from vipetsc.figures.sweep_members import AmplitudeSeries, MemberRun, from_series
from vipetsc.io.read import field_time
from vipetsc.lattice import bloch
from vipetsc.spectra import Nodes, inverse, transform

# The Morlet parameter kc of the bins, for which the paper has no number: that of ``spectra.filter_bank``, and half of
# that of the entropies (``scattering.KC``), since maps of bins are to resolve positions.
BINS_KC = 6.0
SHOWN = 7  # bins whose maps are drawn
EXPLAINED = 4  # bins in the picture that explains them
# Decades below the largest value that the colours of |X| show: two show the packets without their tails.
DOMAIN_DECADES = 2
# The same of the energies of bins, which differ from one another by more.
BINS_DECADES = 4
# The level of contours of a bin's energy, over the largest energy of any bin of that run: it encloses the packets and
# leaves out their tails.
LEVEL = 0.003
FIELD = "partition/kinetic_energy"  # (bin, snapshot, cell)
# Standard deviations of the smoothing before contours are drawn, as fractions of the number of snapshots and of cells.
# The kinetic energy of a wave oscillates at twice its frequency and twice its wavenumber: in records of the default
# length and lattices of the default size the smoothing is wider than that, and narrower than a packet.
BLUR = 0.006, 0.01
# Factor of the colours of the map "turbo": its middle, yellow, would not be seen as a line on white.
DARKENED = 0.85
# Panels of traces end at this multiple of the largest value that they show.
MARGIN = 1.1
# The relative error, Eq. (A8), up to which the paper takes its partition to be complete (its section II.B and Fig. A1).
COMPLETE = 0.01


def bin_colours(count: int) -> np.ndarray:
    """Return colours (bin, rgba) in the order of the spectrum, dark enough for lines."""
    return mpl.colormaps["turbo"](np.linspace(0.04, 0.96, count)) * (DARKENED, DARKENED, DARKENED, 1.0)


def shown_bins(wavenumber: float, count: int, shown: int = SHOWN) -> list[int]:
    """Return at most ``shown`` of ``count`` bins (0-based), spread evenly, with the driven bin and a neighbour.

    The driven bin is that of the ``wavenumber`` in rad/cell. The neighbour is the one on the side of the bin on which
    the wavenumber lies: the packet, which has a width, reaches over into it. With ``shown`` = 1 it is the driven bin
    alone. At 5 pi/9 seven of twelve are, counted from 1 as K_b, the bins 1, 3, 5, 7, 8, 10 and 12.
    """
    if count <= shown:
        return list(range(count))

    position = wavenumber * count / np.pi
    # A wavenumber on the border of two bins is in the upper one, however it is rounded.
    driven = min(int(position + 1e-9), count - 1)
    neighbour = driven - 1
    if position - driven >= 0.5:
        neighbour = driven + 1
    # The first and the last bin have one neighbour.
    if driven == 0:
        neighbour = 1
    if driven == count - 1:
        neighbour = driven - 1
    wanted_bins = [driven, neighbour][:shown]

    # Evenly spread bins may lack a wanted one, or both. What is lacking replaces the nearest bin that is not wanted.
    bins = [round(number) for number in np.linspace(0, count - 1, shown)]
    for wanted in wanted_bins:
        if wanted not in bins:
            others = [i for i, number in enumerate(bins) if number not in wanted_bins]
            nearest = min(others, key=lambda i: abs(bins[i] - wanted))
            bins[nearest] = wanted
    return sorted(bins)


@from_series(FIELD, needs_wave=True)
def partition(series: AmplitudeSeries) -> Figure:
    """Draw the kinetic energies of wavenumber bins in J (paper, Fig. 4).

    (a) Maps of some bins over space and time at the medium amplitude; (b) contours of all bins at each of the three
    amplitudes; (c) the dispersion of the driven band with each bin in the colour of its contours.
    """
    medium = series.medium
    field = medium.analysis[FIELD].load()
    bins = shown_bins(series.wave.wavenumber, len(field))
    colours = bin_colours(len(field))
    norm = panels.log_norm(field[bins], decades=BINS_DECADES)
    amplitude = f"{medium.case.drive.amplitude:g} {drive_unit(medium.case.drive)}"
    figure = style.new_figure(style.PAGE, 6.6, f"{series.title}; maps at {amplitude}")
    upper, lower = figure.subfigures(2, 1, height_ratios=(2, 1.1))

    # A panel for each bin that is shown, and the last one for the driven band.
    grid = upper.subplots(2, SHOWN // 2 + 1)
    *maps, band = grid.flat
    for axes, b in zip(maps, bins, strict=False):
        image = panels.space_time_map(axes, field[b], norm, medium.run)
        is_left = axes in grid[:, 0]
        axes.set(title=f"$K_{{{b + 1}}}$", ylabel="Cell" if is_left else "")
        axes.tick_params(labelleft=is_left)
    for axes in maps[len(bins) :]:
        axes.set_axis_off()
    panels.colour_bar(image, grid, "Energy of a bin in a cell (J)", aspect=40)
    _draw_driven_band(band, series, colours)

    contours = lower.subplots(1, 3, sharey=True)
    for axes, heading, member in zip(contours, series.headings, series.runs, strict=True):
        _draw_contours(axes, member, colours)
        axes.set(title=heading, xlabel="Time (s)")
    contours[0].set_ylabel("Cell")
    number = np.arange(1, len(colours) + 1)
    bounds = np.append(0, number) + 0.5
    keys = mpl.cm.ScalarMappable(BoundaryNorm(bounds, len(colours)), ListedColormap(colours))
    panels.colour_bar(keys, contours, "Bin", ticks=number, extend="neither")
    add_letters([maps[: len(bins)], contours, band])
    return figure


def _draw_driven_band(axes: Axes, series: AmplitudeSeries, colours: np.ndarray) -> None:
    """Draw the dispersion of the driven band, each bin in its colour, and the driven wavenumber."""
    medium = series.medium
    wave = series.wave
    for ends, colour in zip(pairwise(medium.analysis["partition/bounds"].values), colours, strict=True):
        kappa = np.linspace(*ends, 31)
        # Frequencies are in rad/s, and bands count from 1.
        frequency = bloch(medium.model.chain.cell, kappa).frequency[:, wave.band - 1]
        axes.plot(kappa / np.pi, frequency / 1e3, color=colour, lw=3, solid_capstyle="butt")
    axes.axvline(wave.wavenumber / np.pi, color=style.BLACK, lw=0.6, ls=":")
    axes.set(title=f"Band {wave.band} by bin", xlabel="κ (π rad/cell)", ylabel="ω (krad/s)", xlim=(0, 1))


def _draw_contours(axes: Axes, member: MemberRun, colours: np.ndarray) -> None:
    """Draw where the smoothed energy of each bin is above ``LEVEL``, filled and outlined in the bin's colour."""
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
    """Draw total and reconstructed kinetic energy over time, their relative error, and what is between bins.

    That is the paper's Fig. A1. The parts v_b of the velocity add up to it, but their kinetic energies KE_b do not add
    up to that of all masses of the lattice, KE: with the masses m

        KE = sum_b KE_b + sum_(b<c) sum_x m v_b v_c,

    up to the error of the second row. ``cross_share`` of the analysis is 1 - sum_b KE_b / KE, at each time, the part
    of the products in KE. It is not negative. On the line that goes on at rest beyond the ends of the lattice,

        KE - sum_b KE_b = 1/(2 pi) integral of m/2 [1 - sum_b T_b(|eta|)^2] |V(eta)|^2 deta,

    from -pi to pi, summed over the kinds of masses, with the spectrum V of the velocity of each. The filters T_b are
    terms of a sum of positive ones that is 1: they add up to 1 at most, and so do their squares. (They add up to 0.99
    at least where the nodes reach; the second row shows what is missing.) The analysis sums KE_b over the lattice's own
    cells alone, which makes them smaller still. In a single cell m v_b v_c has either sign.
    """
    unit = drive_unit(series.medium.case.drive)
    page = series.page(3, 5.0, sharex="col", sharey="row")
    for (energies, errors, crosses), member in zip(page.grid.T, series.runs, strict=True):
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

    energies, errors, crosses = page.grid[:, 0]
    energies.set(ylabel=f"Kinetic energy / A² (J/{unit}²)", ylim=(0, None))
    energies.legend(loc="upper left")
    errors.set(ylabel="Relative error")
    limit = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "top"}
    panels.note(errors, f"{100 * COMPLETE:g} %", (1, COMPLETE), (-2, -2), **limit)
    crosses.set(ylabel="Fraction of KE between bins")
    return page.lettered()


class Snapshot(NamedTuple):
    """The host ``velocity`` (cell) in m/s at ``time`` in s, and how it is divided into bins.

    ``transformed`` (node, cell) in m/s is its transform X at the ``nodes``, ``parts`` (bin, cell) in m/s are the
    velocities of the bins.
    """

    time: float
    velocity: np.ndarray
    nodes: Nodes
    transformed: np.ndarray
    parts: np.ndarray

    @classmethod
    def nearest(cls, member: MemberRun, wanted: float) -> Self:
        """Return the snapshot of the partition that is nearest to the time ``wanted`` in s.

        Raises ValueError for an analysis whose bins are not those of ``Nodes.bins``.
        """
        snapshots = member.analysis["partition/snapshot"].values
        time = float(snapshots[np.argmin(np.abs(snapshots - wanted))])
        sample = int(np.argmin(np.abs(field_time(member.run) - time)))
        velocity = member.run["velocity"][sample, :, member.model.chain.cell.host].values

        # ``inverse`` sums the nodes of each bin apart, by ``Nodes.bins``.
        nodes = Nodes.log(BINS_KC)
        transformed = transform(velocity, nodes.kappa, BINS_KC)
        parts = inverse(transformed, nodes, BINS_KC)
        bins = member.analysis[FIELD].shape[0]
        if bins != len(parts):
            raise ValueError(f"the analysis has {bins} wavenumber bins, not {len(parts)}: analyse the run again")

        # The lattice's own cells: the transform goes on beyond the last one, and the inverse needs all of it.
        cells = len(velocity)
        return cls(
            time=time, velocity=velocity, nodes=nodes, transformed=transformed[:, :cells], parts=parts[:, :cells]
        )


@from_series(FIELD, needs_wave=True, needs_sites=True, medium_alone=True)
def partition_explained(series: AmplitudeSeries) -> Figure:
    """Draw a snapshot, its wavelet transform cut into bins, the inverse of some, their energy (paper, Fig. S1)."""
    member = series.medium
    field = member.analysis[FIELD].load()
    cells = member.run["cell"].values
    bounds = member.analysis["partition/bounds"].values
    past_last_site = series.snapshot_times()[MOMENTS.index("Past the last site")]
    snapshot = Snapshot.nearest(member, past_last_site)
    bins = shown_bins(series.wave.wavenumber, len(field), EXPLAINED)
    colours = bin_colours(len(field))

    # The halves are subfigures with a gap between them, which the arrows cross.
    heading = f"{series.title}; {member.case.drive.amplitude:g} {drive_unit(member.case.drive)}"
    figure = style.new_figure(style.PAGE, 4.6, heading)
    left, right = figure.subfigures(1, 2, width_ratios=(1, 1.8), wspace=0.1)
    above, below = left.subplots(2, 1, sharex=True)
    above.plot(cells, snapshot.velocity, color=style.BLACK, lw=0.4)
    title = f"Snapshot at t = {snapshot.time:.3g} s"
    above.set(title=title, ylabel="Host velocity (m/s)", xlim=cells[[0, -1]])
    _draw_domain(below, cells, snapshot, bounds)

    largest = MARGIN * np.abs(snapshot.parts[bins]).max()
    norm = panels.log_norm(field[bins], decades=BINS_DECADES)
    grid = right.subplots(len(bins), 2, sharex="col", sharey="col", squeeze=False)
    # Bins rise upwards, as in the wavelet domain.
    for b, (trace, energy) in zip(reversed(bins), grid, strict=True):
        trace.plot(cells, snapshot.parts[b], color=colours[b], lw=0.5)
        trace.set(title=f"Velocity (m/s) of $K_{{{b + 1}}}$", xlim=cells[[0, -1]], ylim=(-largest, largest))
        trace.yaxis.tick_right()

        image = panels.space_time_map(energy, field[b], norm, member.run)
        energy.axvline(snapshot.time, color="white", lw=0.6)
        energy.set(title=f"Energy of $K_{{{b + 1}}}$", xlabel="")

        # The domain shows no wavenumbers below the lowest node and none above pi.
        middle = np.clip(0.5 * (bounds[b] + bounds[b + 1]), snapshot.nodes.kappa[0], np.pi)
        right.add_artist(_arrow(below, float(middle) / np.pi, trace, colours[b]))

    grid[-1, 0].set_xlabel("Cell")
    grid[-1, 1].set_xlabel("Time (s)")
    panels.colour_bar(image, grid[:, 1], "Energy of a bin in a cell (J)", aspect=40)
    add_letters([above, below, *grid.T])
    return figure


def _arrow(domain: Axes, height: float, trace: Axes, colour: np.ndarray) -> ConnectionPatch:
    """Return an arrow from the right edge of ``domain``, at the ordinate ``height``, to the left edge of ``trace``."""
    return ConnectionPatch(
        xyA=(1.0, height),
        coordsA=domain.get_yaxis_transform(),
        xyB=(0.0, 0.5),
        coordsB=trace.transAxes,
        arrowstyle="-|>",
        color=colour,
        lw=0.7,
        mutation_scale=6,
    )


def _draw_domain(axes: Axes, cells: np.ndarray, snapshot: Snapshot, bounds: np.ndarray) -> None:
    """Draw |X| over cells and wavenumber with the ``bounds`` of the bins, each named on the right edge."""
    # Nodes above pi belong to the last bin, but the lattice has no such wavenumbers.
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
    axes.set(title="Wavelets |X| and bins", xlabel="Cell", ylabel="κ (π rad/cell)", ylim=(0, 1))
