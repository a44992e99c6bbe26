"""How the wavenumber partition is made, step by step, from a run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.partition import FIELD, bin_colours, shown_bins
from vipetsc.figures.scattering import ROMAN, mark_sites, snapshot_times
from vipetsc.figures.series import Series, series_of
from vipetsc.figures.study import Study
from vipetsc.spectra import Nodes, inverse, transform

KC = 6.0  # the partition's wavelet
BINS_SHOWN = 4


def partition_explained(study: Study) -> Iterator[Drawing]:
    """A snapshot, its wavelet transform cut into bins, the inverse of some bins, and their energy in space-time."""
    for series in series_of(study, FIELD):
        if series.wave and len(series.runs[1].sites):
            yield series.suffix, partial(_explained, series)


def _explained(series: Series) -> Figure:
    member = series.runs[1]
    run, analysis = member.run, member.analysis
    snapshots, cells = analysis["partition/snapshot"][...], analysis["cell"][...]
    time = float(snapshots[np.argmin(np.abs(snapshots - snapshot_times(series)[2]))])
    host = run.model.chain.cell.host
    signal = run.velocity[int(np.argmin(np.abs(run.field_time - time))), :, host]
    field, bounds = analysis[FIELD], analysis["partition/bounds"][...]
    nodes = Nodes.log(KC)
    full = transform(signal, nodes.kappa, KC)
    parts = inverse(full, nodes, KC, len(field))[:, : len(cells)]
    bins = shown_bins(series.wave.wavenumber, len(field), BINS_SHOWN)
    colours = bin_colours(len(field))

    figure = style.new_figure(style.PAGE, 4.6)
    figure.suptitle(f"{series.title}; medium amplitude, {member.amplitude:g} N", fontsize=8)
    # The empty column leaves room for the arrows.
    grid = figure.add_gridspec(BINS_SHOWN, 4, width_ratios=(1.15, 0.25, 1, 1.05))
    half = BINS_SHOWN // 2
    above, below = figure.add_subplot(grid[:half, 0]), figure.add_subplot(grid[half:, 0])
    above.plot(cells, signal, color=style.BLACK, lw=0.4)
    above.set(ylabel="Host velocity (m/s)", xlim=cells[[0, -1]])
    above.tick_params(labelbottom=False)
    style.letter(above, f"(a) Snapshot at t = {time:.3g} s")
    _domain(below, cells, full[:, : len(cells)], nodes, bounds, colours)
    largest = np.abs(parts[bins]).max()
    norm = style.log_norm(float(max(field[b].max() for b in bins)), 4)
    maps: list[Axes] = []
    # Bins rise upwards, as in the wavelet domain.
    for row, b in enumerate(reversed(bins)):
        trace, energy = figure.add_subplot(grid[row, 2]), figure.add_subplot(grid[row, 3])
        trace.plot(cells, parts[b], color=colours[b], lw=0.5)
        trace.set(xlim=cells[[0, -1]], ylim=(-1.1 * largest, 1.1 * largest))
        trace.yaxis.tick_right()
        image = style.draw_map(energy, snapshots, cells, field[b].T, norm, "inferno")
        mark_sites(energy, member, "y")
        energy.set_ylabel("Cell")
        energy.axvline(time, color="white", lw=0.6)
        for axes, letter, what in ((trace, "c", "Velocity (m/s)"), (energy, "d", "Energy")):
            style.letter(axes, f"({letter}.{ROMAN[row]}) {what} of $K_{{{b + 1}}}$")
            axes.tick_params(labelbottom=row == BINS_SHOWN - 1)
        maps.append(energy)
        middle = float(np.clip(0.5 * (bounds[b] + bounds[b + 1]), nodes.kappa[0], np.pi)) / np.pi
        figure.add_artist(ConnectionPatch(
            (1.0, middle), (0.0, 0.5), below.get_yaxis_transform(), trace.transAxes, arrowstyle="-|>",
            color=colours[b], lw=0.7, mutation_scale=6,
        ))  # fmt: skip
    trace.set(xlabel="Cell")
    energy.set(xlabel="Time (s)")
    figure.colorbar(image, ax=maps, label="Energy of a bin in a cell (J)", pad=0.02, extend="min", aspect=40)
    return figure


def _domain(
    axes: Axes, cells: np.ndarray, x: np.ndarray, nodes: Nodes, bounds: np.ndarray, colours: np.ndarray
) -> None:
    """|X| over cells and wavenumber with the bounds of the bins, each named on the right edge."""
    inside = nodes.kappa <= np.pi
    magnitude = np.abs(x[inside])
    kappa = np.linspace(0, np.pi, 301)[1:]
    nearest = np.abs(nodes.kappa[inside][None, :] - kappa[:, None]).argmin(axis=1)
    norm = style.log_norm(float(magnitude.max()), 2)
    style.draw_map(axes, cells, kappa / np.pi, magnitude[nearest], norm, "magma_r")
    for bound in bounds[1:-1]:
        axes.axhline(bound / np.pi, color=style.GREY, lw=0.4)
    for b, (low, high) in enumerate(itertools.pairwise(bounds)):
        axes.text(0.985, 0.5 * (low + high) / np.pi, f"{b + 1}", transform=axes.get_yaxis_transform(), ha="right",
                  va="center", fontsize=5.5, fontweight="bold", color=colours[b])  # fmt: skip
    axes.set(xlabel="Cell", ylabel="κ (π rad/cell)", ylim=(0, 1))
    style.letter(axes, "(b) Wavelets |X| and bins")
