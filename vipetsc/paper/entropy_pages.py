"""Wavenumber entropy against amplitude: means with power laws (paper, Figs. 5 and S2), histories (Fig. A2)."""

from collections.abc import Collection, Iterator, Sequence
from functools import partial
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure

from vipetsc.case.sweep import coordinate
from vipetsc.figures import panels, style
from vipetsc.figures.measure_panels import cell_edges
from vipetsc.figures.page import Page, legend_entries
from vipetsc.figures.panels import percentile_norm, quantile_band
from vipetsc.figures.series import Series
from vipetsc.figures.style import Drawing
from vipetsc.figures.sweep_members import AMPLITUDE, Sweeps, grouped, in_pi, reading_of, suffix, table
from vipetsc.io.read import axes as axes_of
from vipetsc.io.read import select
from vipetsc.spectra import doubt, normalised
from vipetsc.wording import counted

AVERAGES = {"energy_weighted": "energy-weighted", "masked": "masked", "joint": "joint"}
FACETS = ("reading", "wavenumber")
SPAN = 4e-3, 40.0  # limits of logarithmic axes of values from 0.01 to 1, with room for the text above the peak
FEWEST = 4  # amplitudes of a sweep with pages: with fewer, a peak and a power law beyond it cannot be seen
MOST_ENTRIES = 6  # of the legend: three averages, samples, another reading, the power law
MOST_COLUMNS = 3  # of histories: each is then as wide as a third of a page
FIT_VALUES = ("factor", "exponent", "peak_amplitude", "points", "r2_log_log", "r2_nonlinear")


class EntropyCurve(NamedTuple):
    """Mean entropy over the amplitude, normalised to [0.01, 1], and its power law.

    ``amplitude`` (member,) is in N and rises, ``value`` (member,) is the entropy, ``error`` (member,) its standard
    deviation over the cells, ``fit`` the values of ``FIT_VALUES`` by name. ``band`` are the lowest and the highest
    quantile (member,) over samples of disorder, on the scale of ``value``; None without samples.
    """

    amplitude: np.ndarray
    value: np.ndarray
    error: np.ndarray
    fit: dict[str, float]
    band: Sequence[np.ndarray] | None

    @classmethod
    def of(cls, row: xr.Dataset, average: str) -> Self | None:
        """Return the curve of an ``average``, a key of ``AVERAGES``, over the members in ``row``.

        None if fewer than two members have a value, or all have the same.
        """
        entropy = row[f"entropy/{average}"].values
        valid = np.isfinite(entropy)
        value = entropy[valid]
        if valid.sum() < 2 or np.ptp(value) == 0:
            return None

        # ``normalised`` gives 0.01 + 0.99 (value - least) / range; the deviation and the quantiles are scaled alike.
        scale = 0.99 / np.ptp(value)
        ends = quantile_band(row, f"entropy/{average}")
        band = None
        if ends:
            band = [0.01 + scale * (end[valid] - value.min()) for end in ends]
        return cls(
            amplitude=row[AMPLITUDE].values[valid],
            value=normalised(value),
            error=scale * row["entropy/error"].values[valid],
            fit={name: float(row[f"normalised_fits/entropy/{average}/{name}"]) for name in FIT_VALUES},
            band=band,
        )


class Facet(NamedTuple):
    """The configurations of an ``ensemble`` on one page: each of ``rows`` has its members over rising amplitude.

    ``name`` tells the page from others in a file's name.
    """

    ensemble: xr.Dataset
    rows: Sequence[xr.Dataset]
    name: str

    @property
    def averages(self) -> list[str]:
        """The averages of which any row has a curve."""
        return [average for average in AVERAGES if any(EntropyCurve.of(row, average) for row in self.rows)]

    def row_title(self, row: xr.Dataset) -> str:
        """Return the label of a configuration within its facet: "5 sites"."""
        parts = []
        for name in axes_of(self.ensemble):
            if name not in (*FACETS, AMPLITUDE):
                value = row[name].item()
                parts.append(counted(value, "site") if name == "sites" else f"{name} {value}")
        return ", ".join(parts) or "all members"

    def heading(self, shown: str, wave: bool = True) -> str:
        """Return the sweep's name, the reading, the wavenumber unless it varies, and what is ``shown``."""
        parts = [f"{self._reading()} reading"]
        if wave:
            parts.append(_driven_wavenumber(self.rows[0], self.ensemble))
        parts.append(shown)
        return f"{table(self.ensemble)['name']}: {', '.join(part for part in parts if part)}"

    def _reading(self) -> str:
        if "reading" in axes_of(self.ensemble):
            return str(self.rows[0]["reading"].item())
        return reading_of(self.ensemble)


def entropy(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each reading, wavenumber and average: entropy over amplitude, below in logarithms with fits."""
    for facet in _facets(sweeps):
        for average in facet.averages:
            yield Drawing(f"{facet.name}-{average}", partial(_entropy, facet, average))


def entropy_all(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each reading and average: wavenumbers in rows, configurations in columns, log-log, with fits."""
    for facet in _facets(sweeps, names=("reading",)):
        if len({_driven_wavenumber(row, facet.ensemble) for row in facet.rows}) > 1:
            for average in facet.averages:
                yield Drawing(f"{facet.name}-{average}", partial(_entropy_all, facet, average))


def entropy_history(sweeps: Sweeps) -> Iterator[Drawing]:
    """Offer a page for each reading and wavenumber: of each configuration an image of H(t) over the amplitude."""
    for facet in _facets(sweeps, needs="entropy/history"):
        measured = [row for row in facet.rows if np.isfinite(row["entropy/history"]).any()]
        if measured:
            yield Drawing(facet.name, partial(_history, facet._replace(rows=measured)))


def _facets(sweeps: Sweeps, names: Collection[str] = FACETS, needs: str = "entropy/energy_weighted") -> Iterator[Facet]:
    """Yield the pages of every ensemble with entropies at ``FEWEST`` amplitudes or more, and the variable ``needs``.

    Configurations on one page have the same values of those of the axes ``names`` that the ensemble has.
    """
    measured = []
    for ensemble in sweeps:
        has_entropy = "entropy/energy_weighted" in ensemble and AMPLITUDE in axes_of(ensemble)
        if has_entropy and ensemble.sizes[AMPLITUDE] >= FEWEST:
            measured.append(ensemble)

    for ensemble in measured:
        if needs in ensemble:
            others = [name for name in axes_of(ensemble) if name != AMPLITUDE]
            # The case may list amplitudes in any order, and a curve needs them rising.
            ordered = ensemble.sortby(AMPLITUDE)
            indices = np.ndindex(*(ensemble.sizes[name] for name in others))
            rows = (ordered.isel(dict(zip(others, index, strict=True))) for index in indices)
            facet_name = partial(suffix, ensemble=ensemble, named=len(measured) > 1, dims=names)
            for name, facet_rows in grouped(rows, facet_name).items():
                yield Facet(ensemble, facet_rows, name)


def _driven_wavenumber(row: xr.Dataset, ensemble: xr.Dataset) -> str:
    """Return the drive's wavenumber as a fraction of pi; empty if the sweep drives by frequency."""
    if "wavenumber" in axes_of(ensemble):
        return f"κ* = {in_pi(row['wavenumber'].item())}"
    wavenumber = table(ensemble).get("drive", {}).get("wavenumber")
    return "" if wavenumber is None else f"κ* = {in_pi(coordinate([wavenumber])[0])}"


def _entropy(facet: Facet, average: str) -> Figure:
    """Draw an average over the amplitude for each row: with the other averages, and below in logarithms."""
    columns = 3 if len(facet.rows) > 4 else 2
    heading = facet.heading(f"{AVERAGES[average]} mean entropy")
    page = _page(2, len(facet.rows), 1.55, heading, legend=-(-MOST_ENTRIES // columns))
    for (upper, lower), row in zip(page.grid.T, facet.rows, strict=True):
        upper.set_title(facet.row_title(row))
        curve = _curve_or_reason(upper, row, average)
        if curve is None:
            _scale_logarithmic(lower, row[AMPLITUDE].values)
            continue

        for name, label in AVERAGES.items():
            other = EntropyCurve.of(row, name)
            if other and name != average:
                look = {"lw": 0.6, "alpha": 0.5, **style.CURVES[f"entropy/{name}"]}
                Series(other.amplitude, other.value, look, label).draw(upper)
        _draw_points(upper, curve, average, size=2.2)
        upper.set(xlim=(0, 1.04 * curve.amplitude[-1]), ylim=(-0.05, 1.45))

        _draw_other_readings(lower, facet.ensemble, row, average)
        _draw_log_panel(lower, curve, average, size=2.2)

    for axes in page.grid[0]:
        axes.set_xlabel("A (N)")
    page.body.supylabel("Normalised entropy")
    entries = legend_entries(page.panels)
    page.write_legend(entries.values(), entries.keys(), columns)
    return page.lettered()


def _draw_other_readings(axes: Axes, ensemble: xr.Dataset, row: xr.Dataset, average: str) -> None:
    """Draw the curves of the configuration of ``row`` in the other readings of the sweep, thin and grey."""
    same = {name: row[name].item() for name in axes_of(ensemble) if name != AMPLITUDE}
    if "reading" not in same:
        return
    for reading in ensemble["reading"].values:
        other_row = select(ensemble, **same | {"reading": reading}).sortby(AMPLITUDE)
        other = EntropyCurve.of(other_row, average)
        if other and reading != same["reading"]:
            line = {"color": style.GREY, "lw": 0.7, "ls": (0, (3, 1.5))}
            axes.plot(other.amplitude, other.value, label=f"{reading} reading", **line)


def _entropy_all(facet: Facet, average: str) -> Figure:
    """Draw an average in logarithms: wavenumbers in rows, configurations in columns."""
    by_wavenumber = grouped(facet.rows, partial(_driven_wavenumber, ensemble=facet.ensemble))
    columns = len(facet.rows) // len(by_wavenumber)
    heading = facet.heading(f"{AVERAGES[average]} mean entropy", wave=False)
    page = _page(len(by_wavenumber), columns, 1.25, heading)
    for line, (wavenumber, rows) in zip(page.grid, by_wavenumber.items(), strict=True):
        line[0].set_ylabel(wavenumber)
        for axes, row in zip(line, rows, strict=True):
            curve = _curve_or_reason(axes, row, average)
            if curve is None:
                _scale_logarithmic(axes, row[AMPLITUDE].values)
            else:
                _draw_log_panel(axes, curve, average, size=1.6)
            axes.label_outer()

    for axes, row in zip(page.grid[0], facet.rows, strict=False):
        axes.set_title(facet.row_title(row))
    return page.lettered()


def _curve_or_reason(axes: Axes, row: xr.Dataset, average: str) -> EntropyCurve | None:
    """Return the curve of ``row``; if there is none, None, and write the reason into ``axes``."""
    curve = EntropyCurve.of(row, average)
    if curve is None:
        # The axes stay: those of the last row have the labels of all.
        reason = "nothing touches"
        if np.isfinite(row[f"entropy/{average}"]).sum() < 2:
            reason = "no members"
        axes.text(0.5, 0.5, reason, ha="center", va="center", color=style.GREY, transform=axes.transAxes)
    return curve


def _page(rows: int, columns: int, height: float, heading: str, legend: int = 0) -> Page:
    """Return a page of panels over the amplitude, each row ``height`` inches, with so many lines of a ``legend``."""
    width = style.PAGE * max(columns, 4) / 6
    whole = 0.6 + rows * height
    page = Page.of(rows, columns, width=width, height=whole, heading=heading, legend=legend, sharex="row", sharey="row")
    for axes in page.grid[-1]:
        axes.set_xlabel("A (N)")
    return page


def _draw_points(axes: Axes, curve: EntropyCurve, average: str, size: float) -> None:
    """Draw the points of a curve with bars for the deviation over the cells, over a band for the samples."""
    colour = style.CURVES[f"entropy/{average}"]["color"]
    if curve.band:
        shade = {"color": colour, "alpha": 0.25, "lw": 0, "label": "5 to 95 % of samples"}
        axes.fill_between(curve.amplitude, *curve.band, **shade)

    # Bars of a solid pale colour: transparent ones would darken where they overlap.
    pale = tuple(0.5 + 0.5 * np.array(to_rgb(colour)))
    look = {"fmt": "o-", "color": colour, "ecolor": pale, "ms": size, "mew": 0, "lw": 0.6, "elinewidth": 0.4}
    axes.errorbar(curve.amplitude, curve.value, curve.error, label=f"{AVERAGES[average]}, ± std over the cells", **look)


def _draw_log_panel(axes: Axes, curve: EntropyCurve, average: str, size: float) -> None:
    """Draw the curve in logarithms, the power law from the peak on as a thick black line with both adjusted R^2."""
    _draw_points(axes, curve, average, size)
    amplitude = curve.amplitude
    fit = curve.fit
    doubts = doubt(fit["points"], fit["r2_log_log"])
    if not doubts:
        # The fit was of these points; an amplitude read from a file may differ from its attribute by rounding.
        x = amplitude[amplitude >= fit["peak_amplitude"] * (1 - 1e-9)]
        label = "power law, adjusted R² (nonlinear fit)"
        axes.plot(x, fit["factor"] * x ** fit["exponent"], color=style.BLACK, lw=2.0, zorder=4, label=label)
        text = f"$A^{{{fit['exponent']:.2f}}}$\n$R^2$ {fit['r2_log_log']:.3f} ({fit['r2_nonlinear']:.3f})"
        axes.text(0.04, 0.97, text, transform=axes.transAxes, va="top", fontsize=6)
    else:
        # Not part of the layout, which would narrow all panels for the sake of a long reason.
        text = f"no power law:\n{doubts}"
        axes.text(0.04, 0.97, text, transform=axes.transAxes, va="top", color=style.GREY, fontsize=6, in_layout=False)
    _scale_logarithmic(axes, amplitude)


def _scale_logarithmic(axes: Axes, amplitude: np.ndarray) -> None:
    """Make both ``axes`` logarithmic, from the lowest ``amplitude`` (N) to the highest."""
    axes.set(xscale="log", yscale="log", ylim=SPAN, xlim=(0.8 * amplitude[0], 1.25 * amplitude[-1]))


def _history(facet: Facet) -> Figure:
    """Draw images of H(t) over amplitude, dashed where averages over time begin, dotted where contact begins."""
    columns = min(len(facet.rows), MOST_COLUMNS)
    rows = -(-len(facet.rows) // columns)
    width = max(style.PAGE * columns / MOST_COLUMNS, style.COLUMN)
    heading = facet.heading("entropy H(t) at each amplitude")
    count = len(facet.rows)
    options = {"sharex": True, "sharey": True}
    page = Page.of(rows, columns, width=width, height=0.7 + 1.9 * rows, heading=heading, count=count, **options)

    # One scale of colours for all panels, from the times over which averages are taken: from the wave's arrival at the
    # first site on.
    starts = [float(np.nanmin(row["entropy/start"].values)) for row in facet.rows]
    norm = percentile_norm(
        row["entropy/history"].where(row["entropy/time"] >= start)
        for row, start in zip(facet.rows, starts, strict=True)
    )
    for axes, row, start in zip(page.panels, facet.rows, starts, strict=True):
        image = _draw_history(axes, row, norm)
        axes.set_title(facet.row_title(row))
        if start > 0:
            axes.axvline(start, color="white", lw=0.7, ls="--")
    page.body.supxlabel("Time (s)")
    page.body.supylabel("Amplitude A (N)")
    panels.colour_bar(image, page.grid, "H(t) (bit)", extend="both")
    return page.lettered()


def _draw_history(axes: Axes, row: xr.Dataset, norm: Normalize) -> QuadMesh:
    """Draw H(t) of every amplitude of ``row`` as an image, and a dotted line where contact begins."""
    # A logarithmic axis has no place for a member without a drive.
    row = row.isel({AMPLITUDE: row[AMPLITUDE].values > 0})
    amplitude = row[AMPLITUDE].values

    # Members that failed have no times; the others have the same ones.
    times = row["entropy/time"].values
    time = times[np.argmax(np.isfinite(times).sum(axis=1))]
    finite = np.isfinite(time)
    history = row["entropy/history"].values[:, finite]
    # Edges halfway on the logarithmic axis. Halfway on a linear one, the first edge is negative where the second
    # amplitude is more than three times the first.
    edges = cell_edges(time[finite], "linear"), cell_edges(amplitude, "log")
    image = axes.pcolormesh(*edges, history, norm=norm, rasterized=True)
    axes.set(yscale="log", xlim=time[finite][[0, -1]])

    onset = _contact_onset(amplitude, row["contact_episodes"].values)
    if onset is not None:
        axes.axhline(onset, color="white", lw=0.8, ls=":")
    return image


def _contact_onset(amplitude: np.ndarray, episodes: np.ndarray) -> float | None:
    """Return the amplitude at which contact begins, between the last member without contact and the first one with it.

    ``amplitude`` (member,) rises; ``episodes`` (member,) are numbers of contact episodes, NaN for a member that failed.
    None if there is no such pair of members.
    """
    touching = amplitude[episodes > 0]
    if not touching.size:
        return None
    free = amplitude[(episodes == 0) & (amplitude < touching[0])]
    if not free.size:
        return None
    # Halfway on the logarithmic axis.
    return float(np.sqrt(free[-1] * touching[0]))
