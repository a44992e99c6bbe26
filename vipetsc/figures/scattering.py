"""Wavenumber scattering at three amplitudes: energies, wavelets, entropy.

A sweep over the amplitude A of the drive has a run at its lowest, medium and highest amplitude in each figure. In a
linear lattice energies grow as A^2 and velocities as A: over these, what differs between the panels is nonlinear. The
*driven wavenumber* is that of the linear wave at the drive's frequency, in the pass band that is driven. In a gap there
is none: its mark is missing, and figures with ``needs_wave`` are not drawn. Each figure names what it needs
(``from_series``): a sweep without that has no such picture.

The velocity v(x, t) of the cells' host masses, x being the number of the cell, has the Morlet wavelet transform

    X(kappa, x, t) = sqrt(kc/kappa) 1/(2 pi) integral_0^pi V(eta, t) exp[-(kc eta/kappa - kc)^2/2] exp(i eta x) deta,

with V(eta, t) = sum_x v exp(-i eta x): it is the part of the velocity about the wavenumber kappa and the cell x
(``vipetsc.spectra.wavelet``, with the inverse). A wave v = a cos(kappa x - omega t) has |X| = (a/2) sqrt(kc/kappa) at
its own wavenumber: of waves of equal amplitude the longer ones look stronger. Both directions of travel have the same
kappa. Near kappa = pi the integral ends within the Gaussian, and at pi half of it is cut off. The power S = |X|^2 at
the wavenumbers kappa_j = j pi/60, j = 1..60, gives the local entropy in bits

    W(x, t) = sum_j S,    H(x, t) = -sum_j (S/W) log2 (S/W),    H(t) = sum_x W H / sum_x W

and the mean H(t) over the cells with the weight W (``vipetsc.spectra.entropies``). H lies between 0, for one
wavenumber, and log2 60 = 5.9; it depends on the number of wavenumbers and on kc. "Paper, Fig. n" is a figure of Phys.
Rev. E 108, 044214 (2023).
"""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.amplitude import drive_unit
from vipetsc.figures import panels, style
from vipetsc.figures.sweep_members import AmplitudeSeries, MemberRun, from_series
from vipetsc.io.read import field_time
from vipetsc.lattice import pass_bands
from vipetsc.spectra import transform

# The Morlet parameter kc, in rad: the phase of a wavelet over one standard deviation of its envelope. A wavelet of the
# wavenumber kappa is kc/kappa wide in x and kappa/kc wide in wavenumber. The paper has no number for it. This one, also
# that of the entropies (``spectra.entropies.KC``), resolves wavenumbers better than the smaller one of
# ``wavenumber_bins``, and positions worse.
KC = 12.0
# Wavenumbers in a map of |X|. The entropy's 60 would be seen as steps.
WAVENUMBERS = 120
# Decades below the largest value that the colours of |X| show, at the three amplitudes.
WAVELET_DECADES = 2.5
# Cells and times whose weight W is below this fraction of the largest W of the run show no entropy.
LEAST_WEIGHT = 1e-5
# Fields of the analysis, one a row, by what a pixel of their maps is: the kinetic energy of all masses of a cell at a
# time; that of a wavenumber at a time, both directions of travel together, which add up to that of the lattice; and
# that of a bin of wavenumber and frequency in the mean over time.
ROWS = {
    "kinetic_energy": "Energy of a cell",
    "wavenumber_content": "Energy of a wavenumber",
    "dispersion": "Mean energy of a bin",
}
# Where the mark of the driven wavenumber stands, as a fraction of the panel's width.
MARK_AT = 0.015
# Dispersion maps end at this multiple of the highest frequency of the pass bands.
BEYOND_BANDS = 1.1
# The times of ``AmplitudeSeries.snapshot_times``, in their order.
MOMENTS = ("Before the first site", "At the first site", "Past the last site", "Near the end")


@from_series(*ROWS)
def amplitudes(series: AmplitudeSeries) -> Figure:
    """Draw space-time kinetic energy, wavenumber content and dispersion, a row each; paper, Fig. 2.

    Energies are divided by the square of the amplitude A, so that one scale serves a row: they are in J/N^2, or J/m^2
    where a wall is moved.
    """
    unit = drive_unit(series.medium.case.drive)
    page = series.page(3, 6.4, sharey="row")
    for row, (name, label) in zip(page.grid, ROWS.items(), strict=True):
        fields = [member.analysis[name].load() / member.case.drive.amplitude**2 for member in series.runs]
        norm = panels.log_norm(*fields)
        for axes, field, member in zip(row, fields, series.runs, strict=True):
            if name == "kinetic_energy":
                image = panels.space_time_map(axes, field, norm, member.run)

            elif name == "wavenumber_content":
                image = panels.content_map(axes, field, norm)
                _mark_driven(axes, series)

            else:
                cell = member.model.chain.cell
                image = panels.dispersion_map(axes, field, norm, cell)
                # From rad/s to krad/s.
                axes.set_ylim(0, BEYOND_BANDS * 1e-3 * pass_bands(cell)[-1].high)
        panels.colour_bar(image, row, f"{label} / A² (J/{unit}²)")

    for axes in page.grid[:, 1:].flat:
        axes.set_ylabel("")
    return page.lettered()


def _mark_driven(axes: Axes, series: AmplitudeSeries) -> None:
    """Mark the driven wavenumber at the left end of ``axes``, whose ordinate is kappa/pi, if there is one."""
    if series.wave.band:
        look = {"color": style.SKY, "mec": "white", "mew": 0.3, "ms": 4}
        transform_of_axes = axes.get_yaxis_transform()
        axes.plot(MARK_AT, series.wave.wavenumber / np.pi, ">", transform=transform_of_axes, **look)


class Magnitudes(NamedTuple):
    """|X| of the host velocity over the amplitude, ``values`` (time, wavenumber, cell), at ``time`` in s.

    They are in m/s/N, or in 1/s where a wall is moved.
    """

    time: np.ndarray
    values: np.ndarray


@from_series(needs_wave=True, needs_sites=True)
def wavelets(series: AmplitudeSeries) -> Figure:
    """Draw |X(kappa, x)| of the host velocity over the amplitude, at four times for three amplitudes.

    That is the paper's Fig. 3. A black line marks the driven wavenumber. The times are those of the linear wave
    (``AmplitudeSeries.snapshot_times``), the same for all three runs.
    """
    kappa = np.pi * np.arange(1, WAVENUMBERS + 1) / WAVENUMBERS
    times = series.snapshot_times()
    transforms = [_magnitudes(member, times, kappa) for member in series.runs]
    norm = panels.log_norm(*(transformed.values for transformed in transforms), decades=WAVELET_DECADES)

    page = series.page(4, 6.6, sharex=True, sharey=True)
    for row, moment in enumerate(MOMENTS):
        for axes, transformed, member in zip(page.grid[row], transforms, series.runs, strict=True):
            cells = member.run["cell"].values
            image = panels.draw_map(axes, cells, kappa / np.pi, transformed.values[row], norm, "magma_r")
            axes.axhline(series.wave.wavenumber / np.pi, color=style.BLACK, lw=0.7)
            panels.mark_sites(axes, member.run, style.GREY, "x")
            box = {"facecolor": "white", "alpha": 0.6, "lw": 0, "pad": 1.0}
            text = f"t = {transformed.time[row]:.3g} s"
            axes.text(0.97, 0.94, text, transform=axes.transAxes, ha="right", va="top", bbox=box)
        page.grid[row, 0].set(ylabel=f"{moment}\nκ (π rad/cell)", ylim=(0, 1))

    page.body.supxlabel("Cell")
    unit = drive_unit(series.medium.case.drive)
    panels.colour_bar(image, page.grid, f"Wavelet transform |X| / A (m/s/{unit})", aspect=50)
    return page.lettered()


def _magnitudes(member: MemberRun, times: np.ndarray, kappa: np.ndarray) -> Magnitudes:
    """Return the transforms of the samples nearest to ``times`` (s) at the wavenumbers ``kappa``, in rad per cell."""
    time = field_time(member.run)
    samples = [int(np.argmin(np.abs(time - t))) for t in times]
    # Velocities have the dimensions (time, cell, mass of the cell).
    host = member.run["velocity"][samples, :, member.model.chain.cell.host].values
    # The transform is that of the lattice with rest beyond its last cell: only the lattice's own cells are shown.
    cells = host.shape[-1]
    magnitude = np.abs(transform(host, kappa, KC)[..., :cells])
    return Magnitudes(time=time[samples], values=magnitude / abs(member.case.drive.amplitude))


@from_series("entropy/local")
def entropy_maps(series: AmplitudeSeries) -> Figure:
    """Draw H(x, t) in bits at three amplitudes to one scale, with the energy-weighted H(t) over each; paper, Fig. A2.

    A dashed line marks the time from which averages of H are taken. The analysis has it, as ``entropy/start``: the
    linear wave's arrival at the first site, by the linear run or by the group velocity. Cells are blank where the
    weight W is below ``LEAST_WEIGHT`` of the largest W of the run: only the wavelets' tails are there.
    """
    fields = []
    for member in series.runs:
        weight = member.analysis["entropy/weight"]
        fields.append(member.analysis["entropy/local"].where(weight > LEAST_WEIGHT * weight.max()))
    norm = panels.percentile_norm(fields)

    page = series.page(1, 2.7, sharey=True)
    for axes, field, member in zip(page.panels, fields, series.runs, strict=True):
        image = panels.space_time_map(axes, field, norm)
        image.set_cmap("viridis")
        panels.mark_sites(axes, member.run, style.GREY)
        axes.label_outer()

        # The line has the limits of the colours, so that the colour bar is its axis too. They are percentiles of
        # H(x, t): where H(t) lies beyond one, the line leaves the panel.
        line_axes = axes.twinx()
        time = member.analysis["entropy/snapshot"].values
        history = member.analysis["entropy/history"].values
        start = member.analysis.attrs["entropy/start"]
        line_axes.plot(time, history, color="white", lw=2.0)
        line_axes.plot(time, history, color=style.VERMILION, lw=0.9, label="H(t)")
        line_axes.axvline(start, color=style.BLACK, lw=0.7, ls="--", label="averages begin")
        line_axes.set(ylim=(norm.vmin, norm.vmax), xlim=time[[0, -1]], yticks=[])
    # One legend, in the last panel.
    line_axes.legend(loc="upper left")
    panels.colour_bar(image, page.grid, "H(x, t) and line: H(t) (bit)", extend="both")
    return page.lettered()
