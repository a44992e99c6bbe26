"""Panels that figures share: maps in space-time, dispersion with Bloch branches, marks of sites, shaded bands."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import ArrayLike

from vipetsc import spectra
from vipetsc.case import Model
from vipetsc.figures import style
from vipetsc.lattice import UnitCell, bloch, gaps, pass_bands

DECADES = 5  # of energy that a map shows
PIXELS = 600  # most rows and columns of a map: a printed page shows no more
MOST_LINES = 30  # of sites in a map
ROMAN = ("i", "ii", "iii", "iv", "v", "vi", "vii")
REGIONS = ("", "I", "II", "III", "IV")  # of a frequency-energy branch, by number
REGION_SHADES = ("", "#FFFFFF", "#EAEAEA", "#FFFFFF", "#EEEEEE")
KAPPA, OMEGA = "Wavenumber κ (π rad/cell)", "Frequency ω (krad/s)"


def band_of(row: Mapping[Any, Any], name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Lowest and highest quantile (point) over the samples of the measure ``name``; None of a sweep without samples."""
    if f"statistics/{name}/quantiles" not in row:
        return None
    quantiles = row[f"statistics/{name}/quantiles"].transpose("quantile", ...).values
    return quantiles[0], quantiles[-1]


def annotate_empty(axes: Axes, reason: str) -> None:
    """Fill ``axes`` with the ``reason`` why they show nothing."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, reason, ha="center", va="center", color=style.GREY, wrap=True, transform=axes.transAxes)


def empty_figure(reason: str) -> Figure:
    """A figure of one column that shows the ``reason`` why it is empty."""
    figure = style.new_figure(style.COLUMN, 1.6)
    annotate_empty(figure.subplots(), reason)
    return figure


def block_means(values: np.ndarray) -> np.ndarray:
    """Means over blocks of ``values`` (row, column), so that at most ``PIXELS`` rows and columns are left."""
    for axis, length in enumerate(values.shape):
        values = spectra.block_means(values, -(-length // PIXELS), axis)
    return values


def log_norm(*fields: ArrayLike, decades: float = DECADES) -> LogNorm:
    """Logarithmic colours over ``decades`` below the largest value of the ``fields``, below 1 where they vanish."""
    largest = max(float(np.max(np.asarray(field))) for field in fields)
    top = largest if np.isfinite(largest) and largest > 0 else 1.0
    return LogNorm(top * 10.0**-decades, top, clip=True)


def percentile_norm(fields: Iterable[xr.DataArray]) -> Normalize:
    """Colours from the lowest to the highest percentile of what is finite in the ``fields``."""
    values = np.concatenate([np.ravel(field) for field in fields])
    low, high = np.percentile(values[np.isfinite(values)] if np.isfinite(values).any() else 0, (2, 99.8))
    return Normalize(low, high if high > low else low + 1)


def draw_map(
    axes: Axes, x: np.ndarray, y: np.ndarray, values: np.ndarray, norm: Normalize, cmap: str = "inferno"
) -> AxesImage:
    """Image of ``values`` (y, x) at evenly spaced positions, pooled to what a printed page can show."""
    halves = [0.5 * (axis[-1] - axis[0]) / max(len(axis) - 1, 1) or 0.5 for axis in (x, y)]
    extent = [edge for axis, half in zip((x, y), halves, strict=True) for edge in (axis[0] - half, axis[-1] + half)]
    return axes.imshow(block_means(values), norm=norm, cmap=cmap, extent=extent)


def space_time_map(axes: Axes, field: xr.DataArray, norm: Normalize, run: xr.Dataset | None = None) -> AxesImage:
    """Map of ``field`` (t, cell), time to the right, with the sites of its ``run`` marked."""
    time, cells = (field[dim].values for dim in field.dims)
    image = draw_map(axes, time, cells, field.values.T, norm)
    axes.set(xlabel="Time (s)", ylabel="Cell")
    if run is not None:
        mark_sites(axes, run, cells=cells)
    return image


def content_map(axes: Axes, content: xr.DataArray, norm: Normalize) -> AxesImage:
    """Map of ``content`` (t, wavenumber), time to the right, wavenumbers in pi rad/cell."""
    kappa = content["wavenumber"].values / np.pi
    image = draw_map(axes, content["time"].values, kappa, content.values.T, norm, "viridis")
    axes.set(ylim=(0, kappa[-1]), xlabel="Time (s)", ylabel=KAPPA)
    return image


def recorded_sites(run: xr.Dataset, cells: np.ndarray | None = None) -> np.ndarray:
    """Cells (site), from 1, of the contact sites inside the range of ``cells``, by default the recorded ones."""
    cells, sites = run["cell"].values if cells is None else cells, run["sites/cell"].values
    return sites[(sites >= cells[0]) & (sites <= cells[-1])]


def mark_sites(
    axes: Axes, run: xr.Dataset, colour: str = "white", along: str = "y", cells: np.ndarray | None = None
) -> None:
    """Dotted lines at the ``recorded_sites`` if these are few, triangles on the edge of the axis ``along`` of cells."""
    sites = recorded_sites(run, cells)
    for site in sites if len(sites) <= MOST_LINES else ():
        (axes.axhline if along == "y" else axes.axvline)(site, color=colour, lw=0.5, ls=style.DOTTED, alpha=0.8)
    edge = np.full(len(sites), 0.02)
    points, transform, marker = {
        "x": ((sites, edge), axes.get_xaxis_transform(), "^"),
        "y": ((edge, sites), axes.get_yaxis_transform(), ">"),
    }[along]
    marks = {"color": style.SKY, "mec": "white", "mew": 0.3, "ms": 3.5, "ls": "", "label": "contact sites"}
    axes.plot(*points, marker=marker, transform=transform, **marks)


def indentations(run: xr.Dataset, model: Model) -> np.ndarray:
    """Indentation (site, t) in m of every contact of a ``run`` that recorded all displacements."""
    u, chain, depth = run["displacement"].values, model.chain, []
    gaps = model.gaps or [(gap, gap) for gap in chain.clearances]
    for cell, pair, (plus, minus) in zip(chain.sites, chain.contact_pairs, gaps, strict=True):
        w = u[:, (cell + pair.next_cell) % chain.cells, pair.resonator] - (
            u[:, cell, pair.host] if pair.host >= 0 else 0
        )
        depth.append(np.maximum(np.maximum(w - plus, -w - minus), 0.0))
    return np.array(depth)


def below_cutoff(analysis: xr.Dataset, cell: UnitCell, names: Sequence[str]) -> xr.Dataset:
    """Spectra ``names`` (wavenumber, frequency) up to a tenth above the highest pass band of ``cell``."""
    return analysis[list(names)].sel(frequency=slice(0, 1.1 * pass_bands(cell)[-1].high)).load()


def dispersion_map(axes: Axes, spectrum: xr.DataArray, norm: Normalize, cell: UnitCell) -> AxesImage:
    """Map of ``spectrum`` (wavenumber, frequency) with the Bloch branches of ``cell`` over it, dashed."""
    wavenumber, frequency = spectrum["wavenumber"].values / np.pi, spectrum["frequency"].values / 1e3
    image = draw_map(axes, wavenumber, frequency, spectrum.values.T, norm)
    kappa = np.linspace(0, np.pi, 181)
    axes.plot(kappa / np.pi, bloch(cell, kappa).frequency / 1e3, color="white", lw=0.5, ls=(0, (4, 3)), alpha=0.75)
    axes.set(xlim=(0, wavenumber[-1]), ylim=(0, frequency[-1]), xlabel=KAPPA, ylabel=OMEGA)
    return image


def band_diagram(axes: Axes, cell: UnitCell, frequency: float | None = None) -> None:
    """Bloch branches of ``cell`` in colours, gaps shaded, the drive's ``frequency`` (rad/s) dotted."""
    kappa, bands = np.linspace(0, np.pi, 361), pass_bands(cell)
    axes.plot(kappa / np.pi, bloch(cell, kappa).frequency / 1e3)
    shade_bands(axes, gaps(bands))
    if frequency is not None:
        axes.axhline(frequency / 1e3, color=style.BLACK, lw=0.7, ls=":")
    axes.set(xlim=(0, 1), ylim=(0, 1.08 * bands[-1].high / 1e3), xlabel=KAPPA, ylabel=OMEGA)


def shade_bands(axes: Axes, spans: Iterable[tuple[float, float]], along: str = "y") -> None:
    """Shade ``spans`` of frequency (rad/s) on the axis ``along``, which shows krad/s."""
    for low, high in spans:
        (axes.axhspan if along == "y" else axes.axvspan)(low / 1e3, high / 1e3, color=style.PALE, alpha=0.7, lw=0)


def colour_bar(image: Any, axes: Any, label: str, **options: Any) -> None:
    """Colour bar of a map beside one or several axes; its lowest colour stands for what is below it as well."""
    panels = np.ravel(axes).tolist()
    panels[0].figure.colorbar(image, ax=panels, label=label, **{"pad": 0.02, "extend": "min"} | options)


def note(axes: Axes, text: str, at: Sequence[float], shift: tuple[float, float], **options: Any) -> None:
    """A small text beside the point ``at``, ``shift`` points away from it."""
    axes.annotate(text, at, shift, textcoords="offset points", **options)


def shade_regions(axes: Axes, energy: np.ndarray, region: np.ndarray, left: float, at_top: bool) -> None:
    """Shade the regions I-IV (1-4) of energy (J) of a branch's points, named at the top or the bottom of the panel.

    Each begins where the one below it ends, the first at ``left``.
    """
    low = left
    for number in range(1, 5):
        high = energy[region == number].max(initial=0.0)
        if high > low:
            axes.axvspan(low, high, color=REGION_SHADES[number], lw=0, zorder=0)
            axes.text(np.sqrt(low * high), 0.985 if at_top else 0.015, REGIONS[number], ha="center", color=style.GREY,
                      va="top" if at_top else "bottom", transform=axes.get_xaxis_transform())  # fmt: skip
            low = high
