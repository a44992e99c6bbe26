"""Wavenumber scattering at three amplitudes: energy, wavenumbers, dispersion, wavelets, entropy (Figs. 2, 3, A2)."""

import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import panels, style
from vipetsc.figures.panels import KAPPA, panel_title
from vipetsc.figures.study import AmplitudeSeries, from_series
from vipetsc.io.read import field_time
from vipetsc.lattice import pass_bands
from vipetsc.spectra import transform

KC, NODES = 12.0, 120  # the wavelets of the entropy, on a grid twice as fine
LEAST_WEIGHT = 1e-5  # of the largest: cells with less energy have no entropy
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
        for axes, field, (tag, member, heading) in zip(grid[row], fields, series.headings(row), strict=True):
            if name == "kinetic_energy":
                image = panels.space_time_map(axes, field, norm)
                panels.mark_sites(axes, member.run)
            elif name == "wavenumber_content":
                image = panels.content_map(axes, field, norm)
                axes.plot(0.015, series.wave.wavenumber / np.pi, ">", color=style.SKY, mec="white", mew=0.3, ms=4,
                          transform=axes.get_yaxis_transform())  # fmt: skip
            else:
                image = panels.dispersion_map(axes, field, norm, cell)
            axes.set(xlabel=KAPPA if name == "dispersion" else "Time (s)", ylabel="")
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
        samples = [int(np.argmin(np.abs(time - t))) for t in series.snapshot_times()]
        host = member.run["velocity"][samples, :, member.model.chain.cell.host].values
        fields.append(np.abs(transform(host, kappa, KC)[..., : host.shape[-1]]) / abs(member.amplitude))
        times.append(time[samples])
    norm = panels.log_norm(max(float(field.max()) for field in fields), 2.5)

    figure = style.new_figure(style.PAGE, 6.6, series.title)
    grid = figure.subplots(4, 3, sharex=True, sharey=True)
    for row, moment in enumerate(MOMENTS):
        for axes, field, time, (tag, member, heading) in zip(
            grid[row], fields, times, series.headings(row), strict=True
        ):
            image = panels.draw_map(axes, member.run["cell"].values, kappa / np.pi, field[row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            panels.mark_sites(axes, member.run, style.GREY, "x")
            axes.text(0.97, 0.94, f"t = {time[row]:.3g} s", transform=axes.transAxes, ha="right", va="top",
                      bbox={"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0})  # fmt: skip
            panel_title(axes, f"{tag} {moment}" if row else f"{heading}\n{tag} {moment}")
    grid[0, 0].set(ylim=(0, 1))
    panels.label_outer(grid, "Cell", "κ (π rad/cell)")
    panels.colour_bar(figure, image, grid.flat, "Wavelet transform |X| / A (m/s/N)", aspect=50)
    return figure


@from_series("entropy/local")
def entropy_maps(series: AmplitudeSeries) -> Figure:
    """H(x, t) at three amplitudes to one scale, with the energy-weighted H(t) over each; paper, Fig. A2.

    Cells are blank where they have hardly any energy: only the wavelets' tails are there.
    """
    weights = [member.analysis["entropy/weight"] for member in series.runs]
    fields = [
        member.analysis["entropy/local"].where(weight > LEAST_WEIGHT * weight.max())
        for member, weight in zip(series.runs, weights, strict=True)
    ]
    norm = panels.percentile_norm(fields)
    figure = style.new_figure(style.PAGE, 2.7, series.title)
    grid = figure.subplots(1, 3, sharey=True)
    for axes, field, (tag, member, heading) in zip(grid, fields, series.headings(), strict=True):
        time, history = (member.analysis[f"entropy/{name}"].values for name in ("snapshot", "history"))
        image = panels.space_time_map(axes, field, norm, "viridis")
        panels.mark_sites(axes, member.run, style.GREY)
        # The line shares the colours' limits, so that the colour bar is its axis too.
        over = axes.twinx()
        over.plot(time, history, color="white", lw=2.0)
        over.plot(time, history, color=style.VERMILION, lw=0.9, label="H(t)")
        start = member.analysis.attrs["entropy/start"]
        over.axvline(start, color=style.BLACK, lw=0.7, ls="--", label="averages begin")
        over.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]], yticks=[])
        panel_title(axes, f"{tag} {heading}")
        axes.set_ylabel("Cell" if axes is grid[0] else "")
    over.legend(loc="upper left")
    panels.colour_bar(figure, image, grid, "H(x, t) and line: H(t) (bit)", extend="both")
    return figure
