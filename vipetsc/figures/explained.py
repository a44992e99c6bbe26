"""How the wavenumber partition is made, step by step, from a run (paper, Fig. S1)."""

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
from vipetsc.figures.panels import (
    ROMAN,
    colour_bar,
    draw_map,
    log_norm,
    mark_sites,
    panel_title,
    recorded_sites,
    space_time_map,
)
from vipetsc.figures.partition import DECADES, FIELD, bin_colours, shown_bins
from vipetsc.figures.series import AmplitudeSeries, series_of
from vipetsc.figures.study import Study
from vipetsc.io.read import field_time
from vipetsc.spectra import Nodes, inverse, transform

KC = 6.0  # the partition's wavelet
BINS_SHOWN = 4


def partition_explained(study: Study) -> Iterator[Drawing]:
    """A snapshot, its wavelet transform cut into bins, the inverse of some bins, and their energy in space-time."""
    for series in series_of(study, FIELD):
        if series.drives_a_wave and len(recorded_sites(series.runs[1].run)):
            yield series.suffix, partial(_explained, series)


def _explained(series: AmplitudeSeries) -> Figure:
    member = series.runs[1]
    field, cells = member.analysis[FIELD].load(), member.analysis["cell"].values
    snapshots, bounds = (member.analysis[f"partition/{name}"].values for name in ("snapshot", "bounds"))
    time = float(snapshots[np.argmin(np.abs(snapshots - series.snapshot_times()[2]))])
    sample = int(np.argmin(np.abs(field_time(member.run) - time)))
    signal = member.run["velocity"][sample, :, member.model.chain.cell.host].values
    nodes = Nodes.log(KC)
    wavelets = transform(signal, nodes.kappa, KC)
    parts = inverse(wavelets, nodes, KC, len(field))[:, : len(cells)]
    bins = shown_bins(series.wave.wavenumber, len(field), BINS_SHOWN)
    colours = bin_colours(len(field))

    figure = style.new_figure(style.PAGE, 4.6, f"{series.title}; medium amplitude, {member.amplitude:g} N")
    # The empty column leaves room for the arrows.
    grid = figure.add_gridspec(BINS_SHOWN, 4, width_ratios=(1.15, 0.25, 1, 1.05))
    half = BINS_SHOWN // 2
    above, below = figure.add_subplot(grid[:half, 0]), figure.add_subplot(grid[half:, 0])
    above.plot(cells, signal, color=style.BLACK, lw=0.4)
    above.set(ylabel="Host velocity (m/s)", xlim=cells[[0, -1]])
    above.tick_params(labelbottom=False)
    panel_title(above, f"(a) Snapshot at t = {time:.3g} s")
    _domain(below, cells, wavelets[:, : len(cells)], nodes, bounds, colours)
    largest = 1.1 * np.abs(parts[bins]).max()
    norm = log_norm(float(field[bins].max()), DECADES)
    # Bins rise upwards, as in the wavelet domain.
    traces, maps = ([figure.add_subplot(grid[row, column]) for row in range(BINS_SHOWN)] for column in (2, 3))
    for row, (b, trace, energy) in enumerate(zip(reversed(bins), traces, maps, strict=True)):
        trace.plot(cells, parts[b], color=colours[b], lw=0.5)
        trace.set(xlim=cells[[0, -1]], ylim=(-largest, largest))
        trace.yaxis.tick_right()
        image = space_time_map(energy, field[b], norm)
        mark_sites(energy, member.run)
        energy.axvline(time, color="white", lw=0.6)
        for axes, letter, what in ((trace, "c", "Velocity (m/s)"), (energy, "d", "Energy")):
            panel_title(axes, f"({letter}.{ROMAN[row]}) {what} of $K_{{{b + 1}}}$")
            axes.tick_params(labelbottom=row == BINS_SHOWN - 1)
            axes.set_xlabel("")
        middle = float(np.clip(0.5 * (bounds[b] + bounds[b + 1]), nodes.kappa[0], np.pi)) / np.pi
        ends = (1.0, middle), (0.0, 0.5), below.get_yaxis_transform(), trace.transAxes
        figure.add_artist(ConnectionPatch(*ends, arrowstyle="-|>", color=colours[b], lw=0.7, mutation_scale=6))
    traces[-1].set_xlabel("Cell")
    maps[-1].set_xlabel("Time (s)")
    colour_bar(figure, image, maps, "Energy of a bin in a cell (J)", 0.02, 40)
    return figure


def _domain(
    axes: Axes, cells: np.ndarray, x: np.ndarray, nodes: Nodes, bounds: np.ndarray, colours: np.ndarray
) -> None:
    """|X| over cells and wavenumber with the bounds of the bins, each named on the right edge."""
    inside = nodes.kappa <= np.pi
    magnitude = np.abs(x[inside])
    kappa = np.linspace(0, np.pi, 301)[1:]
    nearest = np.abs(nodes.kappa[inside][None, :] - kappa[:, None]).argmin(axis=1)
    draw_map(axes, cells, kappa / np.pi, magnitude[nearest], log_norm(float(magnitude.max()), 2), "magma_r")
    for bound in bounds[1:-1]:
        axes.axhline(bound / np.pi, color=style.GREY, lw=0.4)
    for b, (low, high) in enumerate(itertools.pairwise(bounds)):
        axes.text(0.985, 0.5 * (low + high) / np.pi, f"{b + 1}", transform=axes.get_yaxis_transform(), ha="right",
                  va="center", fontsize=5.5, fontweight="bold", color=colours[b])  # fmt: skip
    axes.set(xlabel="Cell", ylabel="κ (π rad/cell)", ylim=(0, 1))
    panel_title(axes, "(b) Wavelets |X| and bins")
