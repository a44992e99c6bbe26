"""Wavenumber scattering at three amplitudes: energy, wavenumbers and dispersion; wavelets at four times."""

import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import panels, style
from vipetsc.figures.panels import KAPPA, ROMAN, panel_title
from vipetsc.figures.study import AmplitudeSeries, from_series
from vipetsc.io.read import field_time
from vipetsc.lattice import pass_bands
from vipetsc.spectra import transform

KC, NODES = 12.0, 120  # the wavelets of the entropy, on a grid twice as fine
ROWS = {
    "kinetic_energy": "Energy of a cell",
    "wavenumber_content": "Energy of a wavenumber",
    "dispersion": "Mean energy of a bin",
}
MOMENTS = ("before the first site", "at the first site", "past the last site", "near the end")


@from_series(*ROWS)
def amplitudes(series: AmplitudeSeries) -> Figure:
    """Three amplitudes by (space-time kinetic energy, wavenumber content, dispersion); paper, Fig. 2.

    Energies are divided by the square of the amplitude: one scale serves a row, and what differs between its
    panels is nonlinear.
    """
    figure = style.new_figure(style.PAGE, 6.4, series.title)
    grid = figure.subplots(3, 3, sharey="row")
    cell = series.runs[0].model.chain.cell
    for row, (name, label) in enumerate(ROWS.items()):
        fields = [member.analysis[name].load() / member.amplitude**2 for member in series.runs]
        norm = panels.log_norm(max(float(field.max()) for field in fields))
        for column, member, heading in series.headings():
            axes, field = grid[row, column], fields[column]
            if name == "kinetic_energy":
                image = panels.space_time_map(axes, field, norm)
                panels.mark_sites(axes, member.run)
            elif name == "wavenumber_content":
                time, kappa = field["time"].values, field["wavenumber"].values / np.pi
                image = panels.draw_map(axes, time, kappa, field.values.T, norm, "viridis")
                axes.plot(0.015, series.wave.wavenumber / np.pi, ">", color=style.SKY, mec="white", mew=0.3, ms=4,
                          transform=axes.get_yaxis_transform())  # fmt: skip
            else:
                image = panels.dispersion_map(axes, field, norm, cell)
            axes.set(xlabel=KAPPA if name == "dispersion" else "Time (s)", ylabel="")
            tag = f"({'abc'[column]}.{ROMAN[row]})"
            panel_title(axes, f"{tag} {heading}" if row == 0 else tag)
        panels.colour_bar(figure, image, grid[row], f"{label} / A² (J/N²)")
    grid[0, 0].set(ylabel="Cell")
    grid[1, 0].set(ylabel=KAPPA, ylim=(0, 1))
    grid[2, 0].set(ylabel="Frequency ω (krad/s)", ylim=(0, 1.1e-3 * pass_bands(cell)[-1].high))
    return figure


@from_series(wave=True, sites=True)
def wavelets(series: AmplitudeSeries) -> Figure:
    """|X(kappa, x)| of the host velocity at four times for three amplitudes, over the amplitude; paper, Fig. 3.

    A black line marks the wavenumber of the linear wave at the drive's frequency.
    """
    kappa = np.pi * np.arange(1, NODES + 1) / NODES
    fields, times = [], []
    for member in series.runs:
        time = field_time(member.run)
        rows = [int(np.argmin(np.abs(time - t))) for t in series.snapshot_times()]
        host = member.run["velocity"][rows, :, member.model.chain.cell.host].values
        fields.append(np.abs(transform(host, kappa, KC)[..., : host.shape[-1]]) / abs(member.amplitude))
        times.append(time[rows])
    norm = panels.log_norm(max(float(field.max()) for field in fields), 2.5)

    figure = style.new_figure(style.PAGE, 6.6, series.title)
    grid = figure.subplots(4, 3, sharex=True, sharey=True)
    for column, member, heading in series.headings():
        for row, moment in enumerate(MOMENTS):
            axes, cells = grid[row, column], member.run["cell"].values
            image = panels.draw_map(axes, cells, kappa / np.pi, fields[column][row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            panels.mark_sites(axes, member.run, style.GREY, "x")
            axes.text(0.97, 0.94, f"t = {times[column][row]:.3g} s", transform=axes.transAxes, ha="right", va="top",
                      bbox={"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0})  # fmt: skip
            text = f"({'abc'[column]}.{ROMAN[row]}) {moment}"
            panel_title(axes, text if row else f"{heading}\n{text}")
    grid[0, 0].set(ylim=(0, 1))
    panels.label_outer(grid, "Cell", "κ (π rad/cell)")
    panels.colour_bar(figure, image, grid.flat, "Wavelet transform |X| / A (m/s/N)", aspect=50)
    return figure
