"""Pictures of one run: where its energy is, its dispersion, ledger, phase portraits; the bands of a cell."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.interpolate import Akima1DInterpolator, CubicHermiteSpline

from vipetsc.case import Case, Model
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page
from vipetsc.figures.style import NoPicture
from vipetsc.io.read import field_time
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands
from vipetsc.lattice.damped import decay_length

CELLS = {
    "dispersion_before": "Before the first site",
    "dispersion_after": "After the first site",
    "dispersion": "All cells",
}
LARGEST_RESIDUAL = 1e-8  # of the ledger of a sound run at the default tolerances, over the work of the drive
# Fraction of a record that two periods of the drive may take for energies to be drawn as means over them: a longer mean
# would hide the transient.
MOST_OF_A_RECORD = 0.05
# Points of a phase portrait for each sample. By default there are six samples or more in a period of the top band: the
# corners of the curve are then at most 2 pi/60 = 0.1 rad. The picture takes 0.26 s of CPU with 5, 10 or 20.
REFINE = 10
COLOURS = 256  # of time in a phase portrait: as many as the colour map has


def spacetime(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw kinetic energy (J) of every cell over time with the sites marked, next to the wavenumber content."""
    if "velocity" not in run:
        raise NoPicture("needs the velocities, which were not recorded")
    if analysis is None or analysis.sizes.get("time", 0) < 2:
        raise NoPicture("needs the analysis of a run with two samples or more")

    page = Page.of(columns=1 + ("wavenumber_content" in analysis), height=2.5)
    left, *right = page.panels
    _draw_energy(left, run, analysis)
    for axes in right:
        content = analysis["wavenumber_content"].load()
        image = panels.content_map(axes, content, panels.log_norm(content, decades=4))
        left.set_title("Kinetic energy")
        axes.set_title("Wavenumber content")
        panels.colour_bar(image, axes, "Kinetic energy per bin (J)")
    return page.lettered()


def _draw_energy(axes: Axes, run: xr.Dataset, analysis: xr.Dataset) -> None:
    """Draw a map of the kinetic energy (J) of each cell over time; of a single cell a curve."""
    energy = analysis["kinetic_energy"]
    cells = analysis["cell"].values
    time = analysis["time"].values
    if len(cells) == 1:
        axes.plot(time, energy[:, 0], lw=0.6)
        axes.set(xlabel="Time (s)", ylabel=f"Kinetic energy of cell {cells[0]} (J)", xlim=time[[0, -1]])
        return

    norm = panels.log_norm(energy)
    shown = panels.moved_cells(energy, norm)
    image = panels.space_time_map(axes, shown, norm, run)
    if shown.sizes["cell"] < len(cells):
        axes.set_ylabel("Cell (others hardly move)")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    panels.colour_bar(image, axes, "Kinetic energy of a cell (J)")
    if len(panels.recorded_sites(run, shown["cell"].values)):
        dark = {"frameon": True, "facecolor": style.BLACK, "edgecolor": "none", "framealpha": 0.5}
        axes.legend(loc="upper left", labelcolor="white", handletextpad=0.3, **dark)


def _why_no_dispersion(run: xr.Dataset, analysis: xr.Dataset | None, cell: UnitCell) -> str:
    """Return why the spectra of a ``run`` were not measured."""
    if not cell.joins_cells:
        return "a lattice without springs from cell to cell has no dispersion"
    if run.sizes["cell"] < 2:
        return "needs two cells or more in the record, side by side"
    return _left_out(analysis, "dispersion") or "needs the velocities of all cells"


def _left_out(analysis: xr.Dataset | None, measure: str) -> str:
    """Return the sentence of an ``analysis`` about a ``measure`` that it has left out; empty for none."""
    if analysis is None:
        return ""
    # The attribute has a sentence for each measure that was left out.
    sentences = str(analysis.attrs.get("left_out", ""))
    return next((sentence for sentence in sentences.split("; ") if measure in sentence), "")


def dispersion(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw 2-D spectra of the cells before and after the first site, and their sums over wavenumber."""
    model = Case.of(run).model()
    cell = model.chain.cell
    if analysis is None or not any(name in analysis for name in CELLS):
        raise NoPicture(_why_no_dispersion(run, analysis, cell))

    # The spectrum of all cells together is drawn only if there are none of those before and after a site.
    measured = [name for name in CELLS if name in analysis]
    parts = [name for name in measured if name != "dispersion"]
    spectra = panels.below_cutoff(analysis, cell, parts or measured)
    norm = panels.log_norm(*spectra.values())

    widths = [1.0] * len(spectra) + [0.55]
    width = style.PAGE if len(spectra) > 1 else 5.0
    page = Page.of(columns=len(widths), width=width, height=3.2, sharey=True, width_ratios=widths)
    *maps, side = page.panels
    # The pass bands are shaded, so that the energy that each has received can be read off the sums.
    panels.shade_bands(side, ((band.low, band.high) for band in pass_bands(cell)))
    for axes, (name, spectrum) in zip(maps, spectra.items(), strict=True):
        text = CELLS[str(name)]
        image = panels.dispersion_map(axes, spectrum, norm, cell)
        axes.set_title(text)
        axes.label_outer()
        energy = np.maximum(spectrum.sum("wavenumber"), 1e-300)
        look = {"lw": 0.7, "label": text.split()[0].lower(), **style.CURVES[str(name)]}
        side.plot(energy, energy["frequency"] / 1e3, **look)
    panels.colour_bar(image, [*maps, side], "Mean kinetic energy per bin (J)")

    _mark_drive(side, model)
    largest = float(spectra.sum("wavenumber").to_array().max()) or 1.0
    side.set(xscale="log", xlim=(largest * 1e-7, largest * 3), xlabel="Energy (J)")
    side.set_title("Sum over κ")
    side.legend(loc="lower right")
    return page.lettered()


def _mark_drive(axes: Axes, model: Model) -> None:
    """Draw a dotted line at the frequency of the drive or, if there is none, of the initial motion."""
    frequency = model.drive.frequency / 1e3
    axes.axhline(frequency, color=style.BLACK, lw=0.6, ls=":")
    text = "drive" if model.drive.amplitude else "motion"
    place = {"xycoords": ("axes fraction", "data"), "ha": "left", "va": "bottom"}
    panels.note(axes, text, (0, frequency), (2, 1), **place)


def ledger(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw energies over time, and below them the residual relative to the work done, on a log scale."""
    if len(run["time"]) < 2 or not np.any(run["energy/work"]):
        raise NoPicture("the drive did no work")

    largest = float(np.abs(run["energy/work"]).max())
    page = Page.of(rows=2, height=3.3, sharex=True, height_ratios=(2.2, 1))
    upper, lower = page.panels
    _draw_ledger(upper, run)
    # Room for the legend above the curves, 0.12 of the work for each of its rows.
    rows = -(-len(upper.get_lines()) // 2)
    top = (1.04 + 0.12 * rows) * largest
    upper.set(ylabel="Energy (J)", xlim=run["time"].values[[0, -1]], ylim=(-0.03 * largest, top))
    upper.legend(loc="upper center", ncol=2, columnspacing=1.2, labelspacing=0.25)
    _draw_residual(lower, run, largest)
    upper.set_title("Energies")
    lower.set_title("Residual of their balance over the work")
    return page.lettered()


def _draw_ledger(axes: Axes, run: xr.Dataset) -> None:
    """Draw energies (J) over time: what came in, what is stored and in which parts, and what was lost."""
    time = run["time"].values
    case = Case.of(run)
    kinetic = run["energy/kinetic"]
    contact = run["energy/contact"]
    stored = kinetic + run["energy/spring"] + contact

    # Kinetic and spring energy swing at twice the drive's frequency, which no page can resolve: means over two periods
    # are drawn instead.
    two_periods = 4 * np.pi / case.model().drive.frequency
    window = int(np.ceil(two_periods / (time[1] - time[0])))
    parts = run[["energy/kinetic", "energy/spring"]]
    mean = ""
    if window < MOST_OF_A_RECORD * len(time):
        parts = parts.rolling(time=window, center=True, min_periods=1).mean()
        mean = ", mean"

    given = "initial energy and work" if case.initial else "work of the drive"
    curves = [
        (given, run["energy/work"], "energy/work"),
        ("kinetic + potential", stored, "energy/stored"),
        (f"kinetic{mean}", parts["energy/kinetic"], "energy/kinetic"),
    ]
    # A lattice without springs, sites or dashpots has no curve of their energy.
    if case.model().chain.cell.springs:
        curves.append((f"springs{mean}", parts["energy/spring"], "energy/spring"))
    if run.sizes["site"]:
        curves.append(("contacts", contact, "energy/contact"))
        curves.append(("dissipated", run["energy/dissipated"], "energy/dissipated"))
    if "energy/dissipated_by_damping" in run:
        name = "energy/dissipated_by_damping"
        curves.append(("dissipated in dashpots", run[name], name))
    for label, energy, name in curves:
        axes.plot(time, energy, label=label, lw=0.9, **style.CURVES[name])


def _draw_residual(axes: Axes, run: xr.Dataset, largest: float) -> None:
    """Draw the residual of the balance of energies over the ``largest`` work (J), and the limit of a sound run.

    It is |work - dissipated in contacts - dissipated in dashpots - stored|, 0 but for errors of the integration.
    """
    work = run["energy/work"]
    damped = run.get("energy/dissipated_by_damping", 0.0 * work)
    stored = run["energy/kinetic"] + run["energy/spring"] + run["energy/contact"]
    # Over the largest work, not the present one, which begins at 0.
    residual = np.abs(work - run["energy/dissipated"] - damped - stored) / largest

    axes.semilogy(run["time"].values, np.maximum(residual, 1e-18), color=style.BLACK, lw=0.5)
    axes.axhline(LARGEST_RESIDUAL, color=style.VERMILION, lw=0.7, ls=style.DASHED)
    place = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "bottom", "color": style.VERMILION}
    panels.note(axes, "limit 1e-8", (0.99, LARGEST_RESIDUAL), (0, 1.5), **place)
    axes.locator_params(axis="x", nbins=5)
    top = max(1e-6, 10 * float(residual.max()))
    axes.set(xlabel="Time (s)", ylabel="|Residual| / work", ylim=(1e-15, top))


class Motion(NamedTuple):
    """The motion of a mass, or of one mass relative to another: ``u`` (t,) in m and ``v`` (t,) in m/s.

    ``title`` and ``symbol`` (LaTeX) are its names in a portrait.
    """

    title: str
    symbol: str
    u: np.ndarray
    v: np.ndarray


def phase(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw velocity against displacement at the first site: grey before the first contact, then by time."""
    case = Case.of(run)
    site = case.nearest_site(run["sites/cell"].values)
    if site is None:
        raise NoPicture("the lattice has no contact sites")
    cell = int(run["sites/cell"][site])
    if cell not in run["cell"].values:
        raise NoPicture(f"cell {cell}, the first site, was not recorded")
    if "displacement" not in run or "velocity" not in run:
        raise NoPicture("displacement and velocity were not both recorded")
    if not np.any(run["displacement"].sel(cell=cell)):
        raise NoPicture(f"cell {cell}, the first site, was at rest all the time")
    chain = case.model().chain
    if chain.has_own_pairs:
        raise NoPicture("portraits show the cell's contact pair, but the contacts join other masses")

    recorded = run.sel(cell=cell)
    u, v, time = refined(recorded["displacement"].values, recorded["velocity"].values, field_time(run))
    host = chain.cell.host
    resonator = chain.cell.resonator
    motions = (
        Motion(f"Host of cell {cell}", "u_h", u[:, host], v[:, host]),
        Motion("Resonator of the same cell", "u_r", u[:, resonator], v[:, resonator]),
        Motion("Relative motion", "w", u[:, resonator] - u[:, host], v[:, resonator] - v[:, host]),
    )
    onsets = run["impacts/onset"].values[run["impacts/site"].values == site + 1]
    first_contact = int(np.searchsorted(time, onsets.min(initial=np.inf)))

    page = Page.of(columns=3, height=2.4)
    for axes, motion in zip(page.panels, motions, strict=True):
        by_time = _draw_portrait(axes, motion, time, first_contact)
        velocity = rf"$\dot{{{motion.symbol}}}$ (m/s)"
        axes.set(title=motion.title, xlabel=f"${motion.symbol}$ (mm)", ylabel=velocity)

    relative = page.panels[-1]
    _mark_stops(relative, _stops(run, site))
    if len(onsets):
        panels.colour_bar(by_time, page.panels, "Time (s)", extend="neither")
    else:
        relative.text(0.5, 0.03, "no contact", ha="center", color=style.GREY, transform=relative.transAxes)
    return page.lettered()


def _draw_portrait(axes: Axes, motion: Motion, time: np.ndarray, first_contact: int) -> LineCollection:
    """Draw velocity over displacement in mm, coloured by ``time`` from sample ``first_contact`` on, grey before."""
    points = np.stack([1e3 * motion.u, motion.v], axis=1)

    # A line for each of the map's colours: a segment for each of a hundred thousand samples takes seconds.
    edges = np.linspace(first_contact, len(time) - 1, COLOURS + 1).astype(int)
    begins = edges[:-1]
    ends = edges[1:]
    lines = [points[begin : end + 1] for begin, end in zip(begins, ends, strict=True) if end > begin]
    by_time = LineCollection(lines, array=time[begins[ends > begins]], cmap="viridis", lw=0.4, rasterized=True)
    axes.add_collection(by_time)
    axes.plot(*points[: first_contact + 1].T, color=style.GREY, lw=0.4, rasterized=True)
    centre_axes(axes, points[:, 0], points[:, 1])
    return by_time


def _stops(run: xr.Dataset, site: int) -> list[float]:
    """Return the relative displacements in mm at which the contact of ``site`` (from 0) closes, on one side or both."""
    plus = 1e3 * float(run["sites/clearance"][site])
    minus = plus
    if "sites/clearance_minus" in run:
        minus = 1e3 * float(run["sites/clearance_minus"][site])
    return [stop for stop in (plus, -minus) if np.isfinite(stop)]


def _mark_stops(axes: Axes, stops: list[float]) -> None:
    """Draw the ``stops`` (mm) as dashed lines, and widen the limits of the axis to show them."""
    reach = max(axes.get_xlim()[1], *(1.15 * abs(stop) for stop in stops))
    axes.set_xlim(-reach, reach)
    axes.vlines(stops, *axes.get_ylim(), color=style.VERMILION, lw=0.8, ls=style.DASHED)
    place = {"xycoords": ("data", "axes fraction"), "ha": "right", "va": "top", "color": style.VERMILION}
    box = {"facecolor": "white", "alpha": 0.8, "lw": 0, "pad": 1.0}
    panels.note(axes, "clearance", (stops[0], 1), (-3, -3), bbox=box, **place)


def refined(u: np.ndarray, v: np.ndarray, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ``u`` and ``v`` (time, ...) and ``time`` (time,) with ``REFINE`` points for each sample.

    Curves through them are smooth also where the motion turns fast at a stop.
    """
    if len(time) < 2:
        return u, v, time
    sample = np.arange((len(time) - 1) * REFINE + 1) / REFINE
    fine = np.interp(sample, np.arange(len(time)), time)

    # The slopes of the displacement are the velocities. Those of the velocity are not in the file: Akima's curve takes
    # them from its neighbours, and does not overshoot where the velocity jumps at a stop.
    fine_u = CubicHermiteSpline(time, u, v, axis=0)(fine)
    fine_v = Akima1DInterpolator(time, v)(fine)
    return fine_u, fine_v, fine


def centre_axes(axes: Axes, x: np.ndarray, y: np.ndarray) -> None:
    """Set limits symmetric about zero that hold ``x`` and ``y``, of any shape (...), with a margin."""
    for set_limits, values in ((axes.set_xlim, x), (axes.set_ylim, y)):
        reach = 1.07 * np.abs(values).max() or 1.0
        set_limits(-reach, reach)


def bands(cell: UnitCell, frequency: float | None = None) -> Figure:
    """Draw frequency against wavenumber and group velocity; gaps shaded, a drive's ``frequency`` (rad/s) marked.

    If the cell is damped, a third panel has the decay along the lattice, |Im kappa| of the wave that goes farthest.
    """
    passing = pass_bands(cell)
    widths = [1.3, 1]
    width = 0.72
    if cell.is_damped:
        widths.append(1)
        width = 0.95
    page = Page.of(columns=len(widths), width=style.PAGE * width, height=3.0, sharey=True, width_ratios=widths)
    left, right, *decay = page.panels

    panels.band_diagram(left, cell, frequency)
    for band in passing:
        middle = (band.low + band.high) / 2e3
        colour = style.band_colour(band.number)
        panels.note(left, f"{band.number}", (1, middle), (3, 0), va="center", color=colour)
    left.set_title("Bands; gaps shaded")

    point = bloch(cell, np.linspace(0, np.pi, 361))
    for number, (speed, omega) in enumerate(zip(point.group_velocity.T, point.frequency.T, strict=True), 1):
        right.plot(speed, omega / 1e3, color=style.band_colour(number))
    right.set(title="Group velocity", xlabel="Group velocity dω/dκ (cells/s)")

    for axes in decay:
        omega = np.linspace(0, 1.08 * passing[-1].high, 541)[1:]
        # The rate of decay rather than its length, which is infinite for an undamped wave in a band.
        rates = [1 / decay_length(cell, w) for w in omega.tolist()]
        axes.semilogx(rates, omega / 1e3, color=style.BLACK)
        axes.set(title="Decay along the lattice", xlabel="|Im κ| (1/cell)")

    for axes in (right, *decay):
        panels.shade_bands(axes, gaps(passing))
        if frequency is not None:
            axes.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    right.axvline(0, color=style.GREY, lw=0.5)
    return page.lettered()
