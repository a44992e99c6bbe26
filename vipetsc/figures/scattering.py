"""Wavenumber scattering at three amplitudes: energy, wavenumbers and dispersion; wavelets at four times."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import (
    KAPPA,
    ROMAN,
    colour_bar,
    dispersion_map,
    draw_map,
    log_norm,
    mark_sites,
    panel_title,
    recorded_sites,
    space_time_map,
)
from vipetsc.figures.series import AmplitudeSeries, series_of
from vipetsc.figures.study import MeasuredRun, Study
from vipetsc.io.read import field_time
from vipetsc.lattice import pass_bands
from vipetsc.spectra import transform

KC, NODES = 12.0, 120  # the wavelets of the entropy, on a grid twice as fine


def amplitudes(study: Study) -> Iterator[Drawing]:
    """Three amplitudes by (space-time kinetic energy, wavenumber content, dispersion); paper, Fig. 2.

    Energies are divided by the square of the amplitude: one scale serves a row, and what differs between its
    panels is nonlinear.
    """
    for series in series_of(study, "kinetic_energy", "wavenumber_content", "dispersion"):
        yield series.suffix, partial(_amplitudes, series)


def _amplitudes(series: AmplitudeSeries) -> Figure:
    figure = style.new_figure(style.PAGE, 6.4, series.title)
    grid = figure.subplots(3, 3, sharey="row")
    cell = series.runs[0].model.chain.cell
    labels = "Energy of a cell", "Energy of a wavenumber", "Mean energy of a bin"
    names = "kinetic_energy", "wavenumber_content", "dispersion"
    for row, (name, label) in enumerate(zip(names, labels, strict=True)):
        fields = [member.analysis[name].load() / member.amplitude**2 for member in series.runs]
        norm = log_norm(max(float(field.max()) for field in fields))
        for column, member, heading in series.headings():
            axes, field = grid[row, column], fields[column]
            if name == "kinetic_energy":
                image = space_time_map(axes, field, norm)
                mark_sites(axes, member.run)
            elif name == "wavenumber_content":
                image = _wavenumbers(axes, member, field.values, norm)
                if series.drives_a_wave:
                    axes.plot(0.015, series.wave.wavenumber / np.pi, ">", color=style.SKY, mec="white", mew=0.3, ms=4,
                              transform=axes.get_yaxis_transform())  # fmt: skip
            else:
                image = dispersion_map(axes, field, norm, cell)
            axes.set(xlabel=KAPPA if name == "dispersion" else "Time (s)", ylabel="")
            letter = f"({'abc'[column]}.{ROMAN[row]})"
            panel_title(axes, f"{letter} {heading}" if row == 0 else letter)
        colour_bar(figure, image, grid[row], f"{label} / A² (J/N²)")
    grid[0, 0].set(ylabel="Cell")
    grid[1, 0].set(ylabel=KAPPA, ylim=(0, 1))
    grid[2, 0].set(ylabel="Frequency ω (krad/s)", ylim=(0, 1.1e-3 * pass_bands(cell)[-1].high))
    return figure


def _wavenumbers(axes: Axes, member: MeasuredRun, content: np.ndarray, norm: LogNorm) -> AxesImage:
    time, kappa = member.analysis["time"].values, member.analysis["wavenumber"].values / np.pi
    return draw_map(axes, time, kappa, content.T, norm, "viridis")


def wavelets(study: Study) -> Iterator[Drawing]:
    """|X(kappa, x)| of the host velocity at four times for three amplitudes, over the amplitude; paper, Fig. 3.

    A black line marks the wavenumber of the linear wave at the drive's frequency.
    """
    for series in series_of(study):
        member = series.runs[0]
        if series.drives_a_wave and len(recorded_sites(member.run)) and member.run.sizes["cell"] > 1:
            yield series.suffix, partial(_wavelets, series)


def _wavelets(series: AmplitudeSeries) -> Figure:
    kappa = np.pi * np.arange(1, NODES + 1) / NODES
    names = ("before the first site", "at the first site", "past the last site", "near the end")
    fields, times = [], []
    for member in series.runs:
        time = field_time(member.run)
        rows = [int(np.argmin(np.abs(time - t))) for t in series.snapshot_times()]
        host = member.run["velocity"][rows, :, member.model.chain.cell.host].values
        fields.append(np.abs(transform(host, kappa, KC)[..., : host.shape[-1]]) / abs(member.amplitude))
        times.append(time[rows])
    norm = log_norm(max(float(field.max()) for field in fields), 2.5)

    figure = style.new_figure(style.PAGE, 6.6, series.title)
    grid = figure.subplots(4, 3, sharex=True, sharey=True)
    for column, member, heading in series.headings():
        for row, name in enumerate(names):
            axes, cells = grid[row, column], member.run["cell"].values
            image = draw_map(axes, cells, kappa / np.pi, fields[column][row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            mark_sites(axes, member.run, style.GREY, "x")
            axes.text(0.97, 0.94, f"t = {times[column][row]:.3g} s", transform=axes.transAxes, ha="right", va="top",
                      bbox={"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0})  # fmt: skip
            text = f"({'abc'[column]}.{ROMAN[row]}) {name}"
            panel_title(axes, text if row else f"{heading}\n{text}")
    grid[0, 0].set(ylim=(0, 1))
    for axes in grid[-1]:
        axes.set_xlabel("Cell")
    for axes in grid[:, 0]:
        axes.set_ylabel("κ (π rad/cell)")
    colour_bar(figure, image, grid.flat, "Wavelet transform |X| / A (m/s/N)", aspect=50)
    return figure
