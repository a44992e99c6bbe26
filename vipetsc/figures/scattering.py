"""Wavenumber scattering at three amplitudes: energy, wavenumbers and dispersion; wavelets at four times."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.series import Series, WholeRun, series_of
from vipetsc.figures.study import Study
from vipetsc.lattice import bloch, pass_bands
from vipetsc.spectra import transform

DECADES = 5
KC, NODES = 12.0, 120  # the wavelets of the entropy, on a grid twice as fine
ROMAN = ("i", "ii", "iii", "iv", "v", "vi", "vii")


def amplitudes(study: Study) -> Iterator[Drawing]:
    """Three amplitudes by (space-time kinetic energy, wavenumber content, dispersion).

    Energies are divided by the square of the amplitude: one scale serves a row, and what differs between its
    panels is nonlinear.
    """
    for series in series_of(study, "kinetic_energy", "wavenumber_content", "dispersion"):
        yield series.suffix, partial(_amplitudes, series)


def _amplitudes(series: Series) -> Figure:
    figure = style.new_figure(style.PAGE, 6.4)
    figure.suptitle(series.title, fontsize=8)
    grid = figure.subplots(3, 3, sharey="row")
    rows = (
        ("kinetic_energy", "inferno", "Energy of a cell / A² (J/N²)"),
        ("wavenumber_content", "viridis", "Energy of a wavenumber / A² (J/N²)"),
        ("dispersion", "inferno", "Mean energy of a bin / A² (J/N²)"),
    )
    for row, (name, colours, label) in enumerate(rows):
        fields = [m.analysis[name][...].T / m.amplitude**2 for m in series.runs]
        norm = style.log_norm(max(float(f.max()) for f in fields), DECADES)
        for column, member, heading in series.headings():
            axes = grid[row, column]
            x, y = _coordinates(member, name)
            image = style.draw_map(axes, x, y, fields[column], norm, colours)
            title = f"({'abc'[column]}.{ROMAN[row]})"
            style.letter(axes, f"{title} {heading}" if row == 0 else title)
            if name == "kinetic_energy":
                mark_sites(axes, member, "y")
            elif name == "wavenumber_content" and series.wave:
                _point_at(axes, series.wave.wavenumber / np.pi)
            elif name == "dispersion":
                _branches(axes, member)
        figure.colorbar(image, ax=list(grid[row]), label=label, pad=0.01, extend="min")
    for axes in grid[:2].flat:
        axes.set_xlabel("Time (s)")
    for axes in grid[2]:
        axes.set(xlabel="Wavenumber κ (π rad/cell)", xlim=(0, 1))
    grid[0, 0].set_ylabel("Cell")
    grid[1, 0].set(ylabel="Wavenumber κ (π rad/cell)", ylim=(0, 1))
    cell = series.runs[0].run.model.chain.cell
    grid[2, 0].set(ylabel="Frequency ω (krad/s)", ylim=(0, 1.1e-3 * pass_bands(cell)[-1].high))
    return figure


def _coordinates(member: WholeRun, name: str) -> tuple[np.ndarray, np.ndarray]:
    analysis = member.analysis
    if name == "kinetic_energy":
        return analysis["time"][...], analysis["cell"][...]
    wavenumber = analysis["wavenumber"][...] / np.pi
    if name == "wavenumber_content":
        return analysis["time"][...], wavenumber
    return wavenumber, analysis["frequency"][...] / 1e3


def _branches(axes: Axes, member: WholeRun) -> None:
    kappa = np.linspace(0, np.pi, 181)
    frequency = bloch(member.run.model.chain.cell, kappa).frequency
    axes.plot(kappa / np.pi, frequency / 1e3, color="white", lw=0.6, ls=(0, (4, 3)), alpha=0.7)


def _point_at(axes: Axes, value: float) -> None:
    """A triangle on the left edge that points at ``value``."""
    axes.plot(0.015, value, ">", color=style.SKY, mec="white", mew=0.3, ms=4, transform=axes.get_yaxis_transform())


def mark_sites(axes: Axes, member: WholeRun, along: str, colour: str = "white") -> None:
    """Dotted lines at the contact sites and triangles on the edge of the axis ``along`` ("x" or "y") of cells."""
    sites = member.sites
    edge = np.full(len(sites), 0.015 if along == "y" else 0.03)
    for site in sites:
        draw = axes.axhline if along == "y" else axes.axvline
        draw(site, color=colour, lw=0.5, ls=(0, (1, 2)), alpha=0.8)
    look = {"color": style.SKY, "mec": "white", "mew": 0.3, "ms": 3.5, "ls": ""}
    if along == "y":
        axes.plot(edge, sites, marker=">", transform=axes.get_yaxis_transform(), **look)
    else:
        axes.plot(sites, edge, marker="^", transform=axes.get_xaxis_transform(), **look)


def wavelets(study: Study) -> Iterator[Drawing]:
    """|X(kappa, x)| of the host velocity at four times for three amplitudes, divided by the amplitude.

    A black line marks the wavenumber of the linear wave at the drive's frequency.
    """
    for series in series_of(study):
        if series.wave and len(series.runs[0].sites) and len(series.runs[0].run.cells) > 1:
            yield series.suffix, partial(_wavelets, series)


def snapshot_times(series: Series) -> np.ndarray:
    """Four times in s, from the linear wave: half way to the first site, at it, past the last, near the end.

    The packet's middle leaves the driven cell when half the burst is over.
    """
    member, wave = series.runs[0], series.wave
    model = member.run.model
    distance = np.abs(member.sites - 1 - model.drive_cell)
    burst = model.drive.duration
    past = burst + distance.max() / wave.speed
    times = [0.5 * burst + 0.5 * distance.min() / wave.speed, 0.5 * burst + distance.min() / wave.speed, past]
    last = member.run.field_time[-1]
    return np.minimum(np.array([*times, 0.95 * last]), last)


def _wavelets(series: Series) -> Figure:
    kappa = np.pi * np.arange(1, NODES + 1) / NODES
    times = snapshot_times(series)
    names = ("before the first site", "at the first site", "past the last site", "near the end")
    fields, shown = [], []
    for member in series.runs:
        rows = [int(np.argmin(np.abs(member.run.field_time - t))) for t in times]
        host = member.run.model.chain.cell.host
        signal = np.stack([member.run.velocity[row, :, host] for row in rows])
        cells = signal.shape[-1]
        fields.append(np.abs(transform(signal, kappa, KC)[..., :cells]) / abs(member.amplitude))
        shown.append(member.run.field_time[rows])
    norm = style.log_norm(max(float(f.max()) for f in fields), 2.5)

    figure = style.new_figure(style.PAGE, 6.6)
    figure.suptitle(series.title, fontsize=8)
    grid = figure.subplots(4, 3, sharex=True, sharey=True)
    for column, member, heading in series.headings():
        for row, name in enumerate(names):
            axes = grid[row, column]
            image = style.draw_map(axes, member.run.cells, kappa / np.pi, fields[column][row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            mark_sites(axes, member, "x", style.GREY)
            axes.text(0.97, 0.94, f"t = {shown[column][row]:.3g} s", transform=axes.transAxes, ha="right", va="top",
                      bbox={"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0})  # fmt: skip
            text = f"({'abc'[column]}.{ROMAN[row]}) {name}"
            style.letter(axes, text if row else f"{heading}\n{text}")
    grid[0, 0].set(ylim=(0, 1))
    for axes in grid[-1]:
        axes.set_xlabel("Cell")
    for axes in grid[:, 0]:
        axes.set_ylabel("κ (π rad/cell)")
    figure.colorbar(
        image, ax=list(grid.flat), label="Wavelet transform |X| / A (m/s/N)", pad=0.01, extend="min", aspect=50
    )
    return figure
