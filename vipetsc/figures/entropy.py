"""Wavenumber entropy against amplitude: means with power laws (paper, Figs. 5 and S2), histories (Fig. A2)."""

from collections.abc import Collection, Iterator, Sequence
from functools import partial
from typing import NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vipetsc.case.sweep import coordinate
from vipetsc.figures import panels, style
from vipetsc.figures.panels import band_of, percentile_norm
from vipetsc.figures.sweep_members import AMPLITUDE, Sweeps, counted, grouped, in_pi, reading_of, suffix, table
from vipetsc.io.read import axes as axes_of
from vipetsc.io.read import select
from vipetsc.spectra import doubt, normalised

AVERAGES = {"energy_weighted": "energy-weighted", "masked": "masked", "joint": "joint"}
COLOURS = {"energy_weighted": style.BLUE, "masked": style.VERMILION, "joint": style.GREEN}
FACETS = ("reading", "wavenumber")
SPAN = 4e-3, 40.0  # of the logarithmic axes: room for what is written above the peak
FEWEST = 4  # amplitudes that show a peak and a power law
MOST_COLUMNS = 3  # of histories


class EntropyCurve(NamedTuple):
    """Mean entropy over the amplitude (N), normalised to [.01, 1], its deviation over the cells, its power law.

    ``band`` has the lowest and the highest quantile over the samples, on the same scale.
    """

    amplitude: np.ndarray
    value: np.ndarray
    error: np.ndarray
    fit: dict[str, float]
    band: Sequence[np.ndarray] | None

    @classmethod
    def of(cls, row: xr.Dataset, average: str) -> Self | None:
        """The curve of an average; None where fewer than two members came out, or all are equal."""
        value, error = row[f"entropy/{average}"].values, row["entropy/error"].values
        valid = np.isfinite(value)
        if valid.sum() < 2 or np.ptp(value[valid]) == 0:
            return None
        names = ("factor", "exponent", "peak_amplitude", "points", "r2_log_log", "r2_nonlinear")
        fit = {name: float(row[f"fits/entropy/{average}/{name}"]) for name in names}
        scale = 0.99 / np.ptp(value[valid])
        ends = band_of(row, f"entropy/{average}")
        band = ends and [0.01 + scale * (end[valid] - value[valid].min()) for end in ends]
        return cls(row[AMPLITUDE].values[valid], normalised(value[valid]), scale * error[valid], fit, band)


def entropy(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Entropy against amplitude for each reading, wavenumber and average: linear above, log-log with fits below."""
    for ensemble, rows, stem in _facets(sweeps):
        for average in _averages(rows):
            yield style.Drawing(f"{stem}-{average}", partial(_entropy, ensemble, rows, average))


def entropy_all(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Every wavenumber (rows) and configuration (columns), log-log, with fits and both adjusted R^2."""
    for ensemble, rows, stem in _facets(sweeps, ("reading",)):
        if len({_driven_wavenumber(row, ensemble) for row in rows}) > 1:
            for average in _averages(rows):
                yield style.Drawing(f"{stem}-{average}", partial(_entropy_all, ensemble, rows, average))


def entropy_history(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """H(t) against amplitude as an image for every configuration of a reading and wavenumber."""
    for ensemble, rows, stem in _facets(sweeps, needs="entropy/history"):
        shown = [row for row in rows if np.isfinite(row["entropy/history"]).any()]
        if shown:
            yield style.Drawing(stem, partial(_history, ensemble, shown))


def _facets(
    sweeps: Sweeps, names: Collection[str] = FACETS, needs: str = "entropy/energy_weighted"
) -> Iterator[tuple[xr.Dataset, list[xr.Dataset], str]]:
    """Every ensemble with entropies at ``FEWEST`` amplitudes or more, by those of the axes ``names`` that it has.

    With it a configuration's members over rising amplitude, for each of them, and what tells the facet from others.
    """
    measured = [e for e in sweeps if "entropy/energy_weighted" in e and AMPLITUDE in axes_of(e)]
    measured = [e for e in measured if e.sizes[AMPLITUDE] >= FEWEST]
    for ensemble in (e for e in measured if needs in e):
        others = [name for name in axes_of(ensemble) if name != AMPLITUDE]
        ordered = ensemble.sortby(AMPLITUDE)
        indices = np.ndindex(*(ensemble.sizes[name] for name in others))
        rows = (ordered.isel(dict(zip(others, index, strict=True))) for index in indices)
        stem = partial(suffix, ensemble=ensemble, named=len(measured) > 1, dims=names)
        yield from ((ensemble, of_facet, name) for name, of_facet in grouped(rows, stem).items())


def _averages(rows: Sequence[xr.Dataset]) -> list[str]:
    """The averages of which some of the ``rows`` has a curve."""
    return [average for average in AVERAGES if any(EntropyCurve.of(row, average) for row in rows)]


def _row_title(row: xr.Dataset, ensemble: xr.Dataset) -> str:
    """A configuration in its facet: "5 sites"."""
    values = {name: row[name].item() for name in axes_of(ensemble) if name not in (*FACETS, AMPLITUDE)}
    parts = (counted(value, "site") if name == "sites" else f"{name} {value}" for name, value in values.items())
    return ", ".join(parts) or "all members"


def _driven_wavenumber(row: xr.Dataset, ensemble: xr.Dataset) -> str:
    """The drive's wavenumber as a fraction of pi; empty if the sweep drives by frequency."""
    if "wavenumber" in axes_of(ensemble):
        return f"κ* = {in_pi(row['wavenumber'].item())}"
    shared = table(ensemble).get("drive", {}).get("wavenumber")
    return "" if shared is None else f"κ* = {in_pi(coordinate([shared])[0])}"


def _heading(row: xr.Dataset, ensemble: xr.Dataset, shown: str, wave: bool = True) -> str:
    """The sweep's name, its reading and wavenumber, and what is ``shown``."""
    reading = row["reading"].item() if "reading" in axes_of(ensemble) else reading_of(ensemble)
    parts = f"{reading} reading", _driven_wavenumber(row, ensemble) if wave else "", shown
    return f"{table(ensemble)['name']}: {', '.join(filter(None, parts))}"


def _entropy(ensemble: xr.Dataset, rows: Sequence[xr.Dataset], average: str) -> Figure:
    figure, grid = _panels(2, len(rows), 1.55, _heading(rows[0], ensemble, f"{AVERAGES[average]} mean entropy"))
    for (upper, lower), row in zip(grid.T, rows, strict=True):
        upper.set_title(_row_title(row, ensemble))
        curve = _curve_or_reason(upper, row, average)
        if curve is None:
            lower.set_axis_off()
            continue
        for name, label in AVERAGES.items():
            other = EntropyCurve.of(row, name)
            if other and name != average:
                upper.plot(other.amplitude, other.value, color=COLOURS[name], lw=0.6, alpha=0.5, label=label)
        _points(upper, curve, average, 2.2)
        same = {name: row[name].item() for name in axes_of(ensemble) if name != AMPLITUDE}
        for reading in ensemble["reading"].values if "reading" in same else ():
            other = EntropyCurve.of(select(ensemble, **same | {"reading": reading}).sortby(AMPLITUDE), average)
            if other and reading != same["reading"]:
                line = {"color": style.GREY, "lw": 0.7, "ls": (0, (3, 1.5)), "label": f"{reading} reading"}
                lower.plot(other.amplitude, other.value, **line)
        _log_panel(lower, curve, average, 2.2)
        upper.set(xlim=(0, 1.04 * curve.amplitude[-1]), ylim=(-0.05, 1.45))
    figure.supylabel("Normalised entropy")
    pairs = [pair for axes in grid.flat for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in pairs}
    columns = 3 if len(rows) > 4 else 2
    strip = (0.05 + 0.13 * -(-len(handles) // columns)) / figure.get_figheight()
    figure.get_layout_engine().set(rect=(0, strip, 1, 1 - strip))
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=columns)
    return figure


def _entropy_all(ensemble: xr.Dataset, rows: Sequence[xr.Dataset], average: str) -> Figure:
    by_wavenumber = grouped(rows, partial(_driven_wavenumber, ensemble=ensemble))
    heading = _heading(rows[0], ensemble, f"{AVERAGES[average]} mean entropy", wave=False)
    figure, grid = _panels(len(by_wavenumber), len(rows) // len(by_wavenumber), 1.25, heading)
    for line, (wavenumber, of_wavenumber) in zip(grid, by_wavenumber.items(), strict=True):
        line[0].set_ylabel(wavenumber)
        for axes, row in zip(line, of_wavenumber, strict=True):
            curve = _curve_or_reason(axes, row, average)
            if curve is not None:
                _log_panel(axes, curve, average, 1.6)
            axes.label_outer()
    for axes, row in zip(grid[0], rows, strict=False):
        axes.set_title(_row_title(row, ensemble))
    return figure


def _curve_or_reason(axes: Axes, row: xr.Dataset, average: str) -> EntropyCurve | None:
    """The curve of ``row``; ``axes`` say why if there is none."""
    curve = EntropyCurve.of(row, average)
    if curve is None:
        none_came_out = np.isfinite(row[f"entropy/{average}"]).sum() < 2
        panels.annotate_empty(axes, "no members" if none_came_out else "nothing touches")
    return curve


def _panels(rows: int, columns: int, height: float, heading: str) -> tuple[Figure, np.ndarray]:
    """A page with a grid of panels over the amplitude, each row ``height`` inches."""
    figure = style.new_figure(style.PAGE * max(columns, 4) / 6, 0.6 + rows * height, heading)
    grid = figure.subplots(rows, columns, sharex="row", sharey="row", squeeze=False)
    for axes in grid[-1]:
        axes.set_xlabel("A (N)")
    return figure, grid


def _points(axes: Axes, curve: EntropyCurve, average: str, size: float) -> None:
    if curve.band:
        shade = {"color": COLOURS[average], "alpha": 0.25, "lw": 0, "label": "5 to 95 % of samples"}
        axes.fill_between(curve.amplitude, *curve.band, **shade)
    pale = tuple(0.5 + 0.5 * np.array(to_rgb(COLOURS[average])))
    axes.errorbar(curve.amplitude, curve.value, curve.error, fmt="o-", color=COLOURS[average], ecolor=pale, ms=size,
                  mew=0, lw=0.6, elinewidth=0.4, label=f"{AVERAGES[average]}, ± std over the cells")  # fmt: skip


def _log_panel(axes: Axes, curve: EntropyCurve, average: str, size: float) -> None:
    """The curve in logarithms, the power law from the peak on as a thick black line with both adjusted R^2."""
    _points(axes, curve, average, size)
    amplitude, fit = curve.amplitude, curve.fit
    doubts = doubt(fit["points"], fit["r2_log_log"])
    if not doubts:
        x = amplitude[amplitude >= fit["peak_amplitude"] * (1 - 1e-9)]
        label = "power law, adjusted R² (of nonlinear fit)"
        axes.plot(x, fit["factor"] * x ** fit["exponent"], color=style.BLACK, lw=2.0, zorder=4, label=label)
        text = f"$A^{{{fit['exponent']:.2f}}}$\n$R^2$ {fit['r2_log_log']:.3f} ({fit['r2_nonlinear']:.3f})"
        axes.text(0.04, 0.97, text, transform=axes.transAxes, va="top", fontsize=6)
    else:
        text = f"no power law:\n{doubts}"
        axes.text(0.04, 0.97, text, transform=axes.transAxes, va="top", color=style.GREY, fontsize=6, in_layout=False)
    axes.set(xscale="log", yscale="log", ylim=SPAN, xlim=(0.8 * amplitude[0], 1.25 * amplitude[-1]))


def _history(ensemble: xr.Dataset, configurations: Sequence[xr.Dataset]) -> Figure:
    """Images of H(t) over amplitude, dashed where averages over time begin, dotted where contact begins."""
    columns = min(len(configurations), MOST_COLUMNS)
    rows = -(-len(configurations) // columns)
    width = max(style.PAGE * columns / MOST_COLUMNS, style.COLUMN)
    heading = _heading(configurations[0], ensemble, "entropy H(t) of every amplitude")
    figure = style.new_figure(width, 0.7 + 1.9 * rows, heading)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    # When the averages over time begin.
    shown = [(row, float(np.nanmin(row["entropy/start"].values))) for row in configurations]
    norm = percentile_norm(row["entropy/history"].where(row["entropy/time"] >= start) for row, start in shown)
    for axes, (row, start) in zip(grid.flat, shown, strict=False):
        times, history, amplitude = (row[name].values for name in ("entropy/time", "entropy/history", AMPLITUDE))
        time = times[np.argmax(np.isfinite(times).sum(axis=1))]
        finite = np.isfinite(time)
        image = axes.pcolormesh(time[finite], amplitude, history[:, finite], norm=norm, rasterized=True)
        axes.set(title=_row_title(row, ensemble), yscale="log", xlim=time[finite][[0, -1]])
        touched = row["contact_episodes"].values > 0
        if touched.any() and not touched.all():
            first = int(np.argmax(touched))
            axes.axhline(np.sqrt(amplitude[first - 1] * amplitude[first]), color="white", lw=0.8, ls=":")
        if start > 0:
            axes.axvline(start, color="white", lw=0.7, ls="--")
    for axes in grid.flat[len(configurations) :]:
        axes.set_axis_off()
    figure.supxlabel("Time (s)")
    figure.supylabel("Amplitude A (N)")
    panels.colour_bar(image, grid, "H(t) (bit)", extend="both")
    return figure
