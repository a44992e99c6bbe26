"""Panels of several figures: maps in space-time, dispersion with Bloch branches, marks of sites, shaded bands."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, to_rgba
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator, MultipleLocator
from numpy.typing import ArrayLike

from vipetsc import spectra
from vipetsc.case import Model
from vipetsc.figures import style
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands
from vipetsc.spectra.measures import MOTIONS

DECADES = 5  # decades of energy that a map shows: each then has 50 of the map's 256 colours
# Most rows and columns of a map. A page of maps takes 153 kB as a PDF; at half as many 117 kB, and blocks can be seen.
PIXELS = 600
MOST_DASHED = 12  # branches over a map that are dashed
MOST_LINES = 30  # lines across a map at its sites; more would hide it
REGIONS = ("", "I", "II", "III", "IV")  # of a frequency-energy branch, by number
REGION_SHADES = ("", "#FFFFFF", "#EAEAEA", "#FFFFFF", "#EEEEEE")
ROUNDING = 1e-6  # degrees by which equal phases may differ
LEAST_RATIO = 0.02  # of the range of a vertical axis over its largest value
# Units of a motion in labels, by its quantity.
MOTION_UNITS = {quantity: unit.replace("2", "²") for quantity, unit in MOTIONS.items()}
LEAST_SPAN = 1.0  # degrees of an axis of phases
# Of the cells in a map: fewer would take less than 20 of its 400 pixels.
LEAST_PART = 0.05
KAPPA = "Wavenumber κ (π rad/cell)"
OMEGA = "Frequency ω (krad/s)"


def quantile_band(row: Mapping[Any, Any], name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the ends (point) of the band between the stored quantiles of a measure over samples of disorder.

    ``row`` has the variables of a sweep by name, ``name`` is that of the measure. None without such samples.
    """
    path = f"statistics/{name}/quantiles"
    if path not in row:
        return None
    quantiles = row[path].transpose("quantile", ...).values
    return quantiles[0], quantiles[-1]


def annotate_empty(axes: Axes, reason: str) -> None:
    """Fill ``axes`` with the ``reason`` why they show nothing."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, reason, ha="center", va="center", color=style.GREY, wrap=True, transform=axes.transAxes)


def text_colour(background: Any) -> str:
    """Return black or white, whichever can be read better on the ``background``, a colour of matplotlib.

    It is the one of higher contrast, (L1 + 0.05) / (L2 + 0.05) of their luminances (WCAG 2.1), at least 4.5.
    """
    if luminance(background) > 0.179:
        return style.BLACK
    return "white"


def luminance(colour: Any) -> float:
    """Return the relative luminance of a ``colour`` (WCAG 2.1), 0 for black and 1 for white."""
    *channels, opacity = to_rgba(colour)
    # On white paper.
    channels = 1 - opacity + opacity * np.array(channels)
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def block_means(values: np.ndarray) -> np.ndarray:
    """Return means over blocks of ``values`` (row, column), so that at most ``PIXELS`` rows and columns are left."""
    for axis, length in enumerate(values.shape):
        values = spectra.block_means(values, -(-length // PIXELS), axis)
    return values


def log_norm(*fields: ArrayLike, decades: float = DECADES) -> LogNorm:
    """Return logarithmic colours over ``decades`` below the largest value of all ``fields``.

    Values that are not finite have no part in it. Colours go up to 1 if no value is positive.
    """
    # One scale for all fields, so that equal colours are equal energies.
    values = np.concatenate([np.ravel(field) for field in fields])
    top = float(np.max(values, where=np.isfinite(values), initial=0.0)) or 1.0
    return LogNorm(top * 10.0**-decades, top, clip=True)


def percentile_norm(fields: Iterable[xr.DataArray]) -> Normalize:
    """Return colours from the 2nd to the 99.8th percentile of what is finite in the ``fields``."""
    values = np.concatenate([np.ravel(field) for field in fields])
    finite = values[np.isfinite(values)]
    # Entropies have a few outliers at both ends, for which most of the colours would be used.
    low, high = np.percentile(finite if finite.size else 0, (2, 99.8))
    return Normalize(low, high if high > low else low + 1)


def draw_map(
    axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, norm: Normalize, cmap: str = "inferno"
) -> AxesImage:
    """Draw an image of ``values`` (y, x) at evenly spaced positions ``x`` and ``y``.

    Of more than ``PIXELS`` rows or columns it shows means over blocks.
    """
    x_edges = _edges(x)
    y_edges = _edges(y)
    shown = block_means(values)
    # The last block may have fewer cells than the others, but has the same size in the picture: the picture ends where
    # the field does.
    extent = (*_block_edges(x_edges, len(x)), *_block_edges(y_edges, len(y)))
    image = axes.imshow(shown, norm=norm, cmap=cmap, extent=extent)
    axes.set(xlim=x_edges, ylim=y_edges)
    return image


def _block_edges(edges: tuple[float, float], count: int) -> tuple[float, float]:
    """Return where blocks of `block_means` begin and end that have ``count`` cells between these ``edges``."""
    block = -(-count // PIXELS)
    blocks = -(-count // block)
    begin, end = edges
    return begin, begin + (end - begin) * block * blocks / count


def _edges(positions: np.ndarray) -> tuple[float, float]:
    """Return where an image of pixels centred on evenly spaced ``positions`` begins and ends."""
    spacing = (positions[-1] - positions[0]) / max(len(positions) - 1, 1)
    # A single position has a pixel of the width 1.
    half = 0.5 * spacing or 0.5
    return positions[0] - half, positions[-1] + half


def space_time_map(axes: Axes, field: xr.DataArray, norm: Normalize, run: xr.Dataset | None = None) -> AxesImage:
    """Draw a map of ``field`` (t, cell), time to the right, with the sites of its ``run`` marked."""
    time, cells = (field[dim].values for dim in field.dims)
    image = draw_map(axes, time, cells, field.values.T, norm)
    axes.set(xlabel="Time (s)", ylabel="Cell")
    if run is not None:
        mark_sites(axes, run, cells=cells)
    return image


def moved_cells(field: xr.DataArray, norm: Normalize) -> xr.DataArray:
    """Return the part of ``field`` (t, cell) that a map shows: all cells, or those that the colours of ``norm`` show.

    A short run moves so few cells of a long lattice that a map of all would not show them: if they are less than
    ``LEAST_PART`` of all, they are shown with a tenth of their number on both sides.
    """
    # ``vmin`` is None where the data are to set the colours.
    moved = np.flatnonzero((field > (norm.vmin or 0.0)).any("time").values)
    cells = field.sizes["cell"]
    if not moved.size:
        return field

    first = int(moved[0])
    last = int(moved[-1])
    if last - first + 1 >= LEAST_PART * cells:
        return field
    margin = 1 + (last - first) // 10
    return field.isel(cell=slice(max(first - margin, 0), last + margin + 1))


def content_map(axes: Axes, content: xr.DataArray, norm: Normalize) -> AxesImage:
    """Draw a map of ``content`` (t, wavenumber in rad/cell), time to the right, wavenumbers from 0 to pi upwards.

    The content of real motions is the same at negative wavenumbers.
    """
    kappa = content["wavenumber"].values / np.pi
    image = draw_map(axes, content["time"].values, kappa, content.values.T, norm, "viridis")
    axes.set(ylim=(0, kappa[-1]), xlabel="Time (s)", ylabel=KAPPA)
    return image


def recorded_sites(run: xr.Dataset, cells: np.ndarray | None = None) -> np.ndarray:
    """Return the cells (site), from 1, of the contact sites in the range of ``cells``, by default the recorded ones."""
    if cells is None:
        cells = run["cell"].values
    sites = run["sites/cell"].values
    return sites[(sites >= cells[0]) & (sites <= cells[-1])]


def mark_sites(
    axes: Axes, run: xr.Dataset, colour: str = "white", along: str = "y", cells: np.ndarray | None = None
) -> None:
    """Draw triangles on the edge of a map at the sites of a ``run``, and dotted lines across it if these are few.

    ``along`` is the axis of the cells, "x" or "y"; sites out of the range of ``cells`` (cell,), by default the recorded
    ones, are left out.
    """
    sites = recorded_sites(run, cells)
    edge = np.full(len(sites), 0.02)
    look = {"color": style.SKY, "mec": "white", "mew": 0.3, "ms": 3.5, "ls": "", "label": "contact sites"}
    draw_line = axes.axhline if along == "y" else axes.axvline
    if len(sites) <= MOST_LINES:
        for site in sites:
            draw_line(site, color=colour, lw=0.5, ls=style.DOTTED, alpha=0.8)
    if along == "y":
        axes.plot(edge, sites, marker=">", transform=axes.get_yaxis_transform(), **look)
    else:
        axes.plot(sites, edge, marker="^", transform=axes.get_xaxis_transform(), **look)


def indentations(run: xr.Dataset, model: Model) -> np.ndarray:
    """Return the indentation (site, t) in m of every contact of a ``run`` that recorded all displacements."""
    u = run["displacement"].values
    chain = model.chain
    depth = []
    for site in chain.sites:
        plus, minus = site.gaps
        w = site.pair.relative(u, site.cell)
        depth.append(np.maximum(np.maximum(w - plus, -w - minus), 0.0))
    return np.array(depth)


def below_cutoff(analysis: xr.Dataset, cell: UnitCell, names: Sequence[str]) -> xr.Dataset:
    """Return spectra ``names`` (wavenumber, frequency) up to a tenth above the highest pass band of ``cell``."""
    cutoff = pass_bands(cell)[-1].high
    return analysis[list(names)].sel(frequency=slice(0, 1.1 * cutoff)).load()


def dispersion_map(axes: Axes, spectrum: xr.DataArray, norm: Normalize, cell: UnitCell) -> AxesImage:
    """Draw a map of ``spectrum`` (wavenumber, frequency) with the Bloch branches of ``cell`` over it, dashed."""
    wavenumber = spectrum["wavenumber"].values / np.pi
    frequency = spectrum["frequency"].values / 1e3
    image = draw_map(axes, wavenumber, frequency, spectrum.values.T, norm)
    # At intervals of one degree of phase a cell, at which the steepest branches look smooth.
    kappa = np.linspace(0, np.pi, 181)
    look: dict[str, Any] = {"lw": 0.5, "ls": (0, (4, 3)), "alpha": 0.75}
    # Dashes of many branches side by side make a pattern of their own.
    if cell.dofs > MOST_DASHED:
        look = {"lw": 0.25, "alpha": 0.5}
    axes.plot(kappa / np.pi, bloch(cell, kappa).frequency / 1e3, color="white", **look)
    axes.set(xlim=(0, wavenumber[-1]), ylim=(0, frequency[-1]), xlabel=KAPPA, ylabel=OMEGA)
    return image


def band_diagram(axes: Axes, cell: UnitCell, frequency: float | None = None) -> None:
    """Draw the Bloch branches of ``cell`` in colours, gaps shaded, the drive's ``frequency`` (rad/s) dotted."""
    kappa = np.linspace(0, np.pi, 361)
    bands = pass_bands(cell)
    for number, frequencies in enumerate(bloch(cell, kappa).frequency.T, 1):
        axes.plot(kappa / np.pi, frequencies / 1e3, color=style.band_colour(number))
    shade_bands(axes, gaps(bands))
    if frequency is not None:
        axes.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), ylim=(0, 1.08 * bands[-1].high / 1e3), xlabel=KAPPA, ylabel=OMEGA)


def shade_bands(axes: Axes, spans: Iterable[tuple[float, float]], along: str = "y") -> None:
    """Shade ``spans`` of frequency (rad/s) on the axis ``along``, which shows krad/s."""
    draw_span = axes.axhspan if along == "y" else axes.axvspan
    for low, high in spans:
        draw_span(low / 1e3, high / 1e3, color=style.PALE, alpha=0.7, lw=0)


def colour_bar(image: Any, axes: Any, label: str, **options: Any) -> None:
    """Draw the colour bar of a map at one or several axes, with an arrow for values below the lowest colour's."""
    panels = np.ravel(axes).tolist()
    options = {"extend": "min"} | options
    if "cax" not in options:
        options = {"ax": panels, "pad": 0.02} | options
    panels[0].figure.colorbar(image, label=label, **options)


def bar_axes(axes: Axes) -> Axes:
    """Return axes for a colour bar as high as ``axes``, which may be less high than the figure has room for."""
    return axes.inset_axes((1.02, 0, 0.03 * max(1, axes.get_data_ratio()), 1))


def site_labels(run: xr.Dataset) -> list[str]:
    """Return the number of the cell of each contact site of a ``run``; of a strip of the plane also that of its row."""
    labels = [f"{cell}" for cell in run["sites/cell"].values]
    if "sites/row" in run:
        rows = run["sites/row"].values
        labels = [f"{label}, {row}" for label, row in zip(labels, rows, strict=True)]
    return labels


def sites_title(run: xr.Dataset) -> str:
    """Return what ``site_labels`` are."""
    if "sites/row" in run:
        return "cell, row"
    return "cell"


def continuous_phase(angle: np.ndarray, begin: float) -> np.ndarray:
    """Return angles (point,) in degrees without jumps by revolutions, the first between ``begin`` and ``begin`` + 360.

    A jump by half a revolution, from phase to antiphase in a lattice without loss, is drawn as it is, since rounding
    would decide on its direction.
    """
    turned = begin + np.mod(angle - begin, 360)
    return np.unwrap(turned, discont=180 + ROUNDING, period=360)


def mark_degrees(axes: Axes) -> None:
    """Put few ticks on a vertical axis in degrees.

    They are multiples of 180 degrees on an axis of more than a revolution, and otherwise multiples of 1, 1.5, 3, 4.5 or
    9 times a power of ten, such as 45 and 90. The axis spans ``LEAST_SPAN`` or more, so that the rounding of a constant
    phase is not seen; all curves must be there.
    """
    low, high = axes.get_ylim()
    if high - low < LEAST_SPAN:
        middle = (low + high) / 2
        axes.set_ylim(middle - LEAST_SPAN / 2, middle + LEAST_SPAN / 2)
    if high - low > 360:
        half_revolutions = (high - low) / 180
        axes.yaxis.set_major_locator(MultipleLocator(180 * np.ceil(half_revolutions / 5)))
        return
    axes.yaxis.set_major_locator(MaxNLocator(nbins=4, steps=[1, 1.5, 3, 4.5, 9, 10]))


def widen(axes: Axes) -> None:
    """Let the vertical axis span ``LEAST_RATIO`` of its largest value, so that rounding of a constant is not seen."""
    low, high = axes.get_ylim()
    least = LEAST_RATIO * max(abs(low), abs(high))
    if high - low < least:
        middle = (low + high) / 2
        axes.set_ylim(middle - least / 2, middle + least / 2)


def note(axes: Axes, text: str, at: Sequence[float], shift: tuple[float, float], **options: Any) -> None:
    """Write a small text near the point ``at``, ``shift`` points away from it."""
    axes.annotate(text, at, shift, textcoords="offset points", **options)


def shade_regions(axes: Axes, energy: np.ndarray, region: np.ndarray, left: float, at_top: bool) -> None:
    """Shade the regions I-IV of a branch (``modes.branches.regions``) on the axis of energy, and name them.

    ``energy`` (point,) in J and ``region`` (point,), 1 to 4, are those of the branch. Each region is shaded from where
    the one below it ends, the first from ``left`` above 0, to the largest energy of its points; a region without points
    above the one below is left out. Names are at the top or the bottom of the panel.
    """
    height = 0.985 if at_top else 0.015
    look = {"ha": "center", "va": "top" if at_top else "bottom", "color": style.GREY}
    low = left
    for number in range(1, 5):
        high = energy[region == number].max(initial=0.0)
        if high > low:
            axes.axvspan(low, high, color=REGION_SHADES[number], lw=0, zorder=0)
            middle = np.sqrt(low * high)  # of a logarithmic axis
            axes.text(middle, height, REGIONS[number], transform=axes.get_xaxis_transform(), **look)
            low = high
