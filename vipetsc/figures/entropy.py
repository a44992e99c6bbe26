"""Mean wavenumber entropy against amplitude, with the power laws fitted from the peak on (paper, Figs. 5 and S2)."""

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vipetsc.case.sweep import coordinate
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import annotate_empty, label_outer, panel_title
from vipetsc.figures.study import AMPLITUDE, Study, counted, grouped, in_pi, reading_of, suffix, table
from vipetsc.io.read import axes as axes_of

AVERAGES = {"energy_weighted": "energy-weighted", "masked": "masked", "joint": "joint"}
COLOURS = {"energy_weighted": style.BLUE, "masked": style.VERMILION, "joint": style.GREEN}
LOW, HIGH = 0.01, 1.0  # what a normalised curve runs between
LABELS = 5  # most labels of the legend: three averages, another reading, the power law
FACETS = ("reading", "wavenumber")
SPAN = 4e-3, 40.0  # of the logarithmic axes: room for what is written above the peak
FEWEST = 4  # amplitudes that show a peak and a power law


class EntropyCurve(NamedTuple):
    """One configuration's mean entropy over ``amplitude`` in N, normalised to [.01, 1], and its power law.

    ``error`` is the deviation over the cells on the same scale; ``fit`` what ``/fits`` says of the curve.
    """

    amplitude: np.ndarray
    value: np.ndarray
    error: np.ndarray
    fit: dict[str, float]

    @classmethod
    def of(cls, row: xr.Dataset, average: str) -> Self | None:
        """The curve of an average; None where fewer than two members came out, or all alike."""
        value, error = row[f"entropy/{average}"].values, row["entropy/error"].values
        valid = np.isfinite(value)
        if valid.sum() < 2 or np.ptp(value[valid]) == 0:
            return None
        scale = (HIGH - LOW) / np.ptp(value[valid])
        names = ("factor", "exponent", "peak_amplitude", "r2_log_log", "r2_nonlinear")
        fit = {name: float(row[f"fits/entropy/{average}/{name}"]) for name in names}
        normalised = LOW + scale * (value[valid] - value[valid].min())
        return cls(row[AMPLITUDE].values[valid], normalised, scale * error[valid], fit)

    def power_law(self) -> tuple[np.ndarray, np.ndarray]:
        """Amplitudes from the peak on and the log-log line there; empty without a fit."""
        if not np.isfinite(self.fit["factor"]):
            return np.zeros(0), np.zeros(0)
        x = self.amplitude[self.amplitude >= self.fit["peak_amplitude"] * (1 - 1e-9)]
        return x, self.fit["factor"] * x ** self.fit["exponent"]


def with_entropies(study: Study, name: str = "entropy/energy_weighted") -> Iterator[tuple[xr.Dataset, bool]]:
    """The ensembles with entropies at four amplitudes or more, and whether their pictures need the sweep's name."""
    measured = [e for e in study.ensembles if "entropy/energy_weighted" in e and AMPLITUDE in axes_of(e)]
    measured = [e for e in measured if e.sizes[AMPLITUDE] >= FEWEST]
    yield from ((e, len(measured) > 1) for e in measured if name in e)


def rows_of(ensemble: xr.Dataset) -> list[xr.Dataset]:
    """The members of each configuration over rising amplitude; the values of all other axes are scalars."""
    others = [name for name in axes_of(ensemble) if name != AMPLITUDE]
    ordered = ensemble.sortby(AMPLITUDE)
    shape = [ensemble.sizes[name] for name in others]
    return [ordered.isel(dict(zip(others, map(int, index), strict=True))) for index in np.ndindex(*shape)]


def facets(ensemble: xr.Dataset, names: Collection[str] = FACETS) -> list[list[xr.Dataset]]:
    """The rows by the values of ``names``, those that the sweep varies."""
    varied = [name for name in names if name in axes_of(ensemble)]
    return list(grouped(rows_of(ensemble), lambda row: repr([row[name].item() for name in varied])).values())


def row_title(row: xr.Dataset, ensemble: xr.Dataset) -> str:
    """A configuration in its facet: "5 sites"."""
    parts = []
    for name in axes_of(ensemble):
        if name not in (*FACETS, AMPLITUDE):
            value = row[name].item()
            parts.append(counted(value, "site") if name == "sites" else f"{name} {value}")
    return ", ".join(parts) or "all members"


def driven_wavenumber(row: xr.Dataset, ensemble: xr.Dataset) -> str:
    """The drive's wavenumber as a fraction of pi; empty if the sweep drives by frequency."""
    if "wavenumber" in axes_of(ensemble):
        return f"κ* = {in_pi(row['wavenumber'].item())}"
    shared = table(ensemble).get("drive", {}).get("wavenumber")
    return "" if shared is None else f"κ* = {in_pi(coordinate([shared])[0])}"


def facet_title(row: xr.Dataset, ensemble: xr.Dataset, wave: bool = True) -> str:
    """The sweep's name, its reading and wavenumber."""
    reading = row["reading"].item() if "reading" in axes_of(ensemble) else reading_of(ensemble)
    parts = f"{reading} reading", driven_wavenumber(row, ensemble) if wave else ""
    return f"{table(ensemble)['name']}: {', '.join(filter(None, parts))}"


def entropy(study: Study) -> Iterator[Drawing]:
    """Entropy against amplitude for each reading, wavenumber and average: linear above, log-log with fits below."""
    for ensemble, named in with_entropies(study):
        for rows in facets(ensemble):
            yield from _by_average(_entropy, ensemble, rows, suffix(rows[0], ensemble, named, FACETS))


def entropy_all(study: Study) -> Iterator[Drawing]:
    """Every wavenumber (rows) and configuration (columns), log-log, with fits and both adjusted R^2."""
    for ensemble, named in with_entropies(study):
        for rows in facets(ensemble, ("reading",)):
            if len({driven_wavenumber(row, ensemble) for row in rows}) > 1:
                yield from _by_average(_entropy_all, ensemble, rows, suffix(rows[0], ensemble, named, ("reading",)))


def _by_average(
    page: Callable[..., Figure], ensemble: xr.Dataset, rows: Sequence[xr.Dataset], stem: str
) -> Iterator[Drawing]:
    """A page for every average of which some of the ``rows`` has a curve."""
    for average in AVERAGES:
        if any(EntropyCurve.of(row, average) for row in rows):
            yield f"{stem}-{average}", partial(page, ensemble, rows, average)


def _entropy(ensemble: xr.Dataset, rows: Sequence[xr.Dataset], average: str) -> Figure:
    heading = f"{facet_title(rows[0], ensemble)}, {AVERAGES[average]} mean entropy"
    figure, grid = _panels(2, len(rows), 1.42, heading, 0.38, LABELS)
    for (upper, lower), row in zip(grid.T, rows, strict=True):
        panel_title(upper, row_title(row, ensemble))
        curve = EntropyCurve.of(row, average)
        if curve is None:
            annotate_empty(upper, _why_no_curve(row, average))
            annotate_empty(lower, "")
            continue
        for name, label in AVERAGES.items():
            if name != average:
                _faint(upper, row, name, label, color=COLOURS[name], lw=0.6, alpha=0.5)
        _points(upper, curve, average, 2.2)
        for other in _other_readings(row, ensemble):
            label = f"{other['reading'].item()} reading"
            _faint(lower, other, average, label, color=style.GREY, lw=0.7, ls=(0, (3, 1.5)))
        _log_panel(lower, curve, average, 2.2, 6.0)
        upper.set(xlim=(0, 1.04 * curve.amplitude[-1]), ylim=(-0.05, 1.45))
    label_outer(grid, "A (N)", "Normalised entropy")
    pairs = [pair for axes in grid.flat for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in pairs}
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=_legend_columns(len(rows)))
    return figure


def _entropy_all(ensemble: xr.Dataset, rows: Sequence[xr.Dataset], average: str) -> Figure:
    by_wavenumber = grouped(rows, partial(driven_wavenumber, ensemble=ensemble))
    heading = f"{facet_title(rows[0], ensemble, False)}, {AVERAGES[average]} mean entropy"
    figure, grid = _panels(len(by_wavenumber), len(rows) // len(by_wavenumber), 1.15, heading)
    label_outer(grid, "A (N)", "")
    for line, (wavenumber, of_wavenumber) in zip(grid, by_wavenumber.items(), strict=True):
        line[0].set_ylabel(wavenumber)
        for axes, row in zip(line, of_wavenumber, strict=True):
            curve = EntropyCurve.of(row, average)
            if axes in grid[0]:
                panel_title(axes, row_title(row, ensemble))
            if curve is None:
                annotate_empty(axes, _why_no_curve(row, average))
                continue
            _log_panel(axes, curve, average, 1.6, 5.5)
            axes.tick_params(labelbottom=axes in grid[-1])
    return figure


def _other_readings(row: xr.Dataset, ensemble: xr.Dataset) -> Iterator[xr.Dataset]:
    """The same configuration in the other readings."""
    if "reading" in axes_of(ensemble):
        same = [name for name in axes_of(ensemble) if name not in ("reading", AMPLITUDE)]
        for other in rows_of(ensemble):
            if other["reading"] != row["reading"] and all(other[name] == row[name] for name in same):
                yield other


def _why_no_curve(row: xr.Dataset, average: str) -> str:
    return "no members" if np.isfinite(row[f"entropy/{average}"]).sum() < 2 else "nothing touches"


def _legend_columns(columns: int) -> int:
    return 3 if columns > 4 else 2


def _panels(
    rows: int, columns: int, height: float, heading: str, gap: float = 0.1, labels: int = 0
) -> tuple[Figure, np.ndarray]:
    """A grid of panels of ``height`` inches, ``gap`` apart, and room for a legend of so many ``labels``.

    Laid out by hand, since fitting dozens of panels takes long.
    """
    left, right, top, bottom = 0.52, 0.06, 0.45, 0.42 + 0.15 * -(-labels // _legend_columns(columns))
    width = style.PAGE * max(columns, 4) / 6
    tall = top + bottom + rows * height + (rows - 1) * gap
    figure = style.new_figure(width, tall, fitted=False)
    figure.suptitle(heading, fontsize=8, y=1 - 0.05 / tall, va="top")
    grid = figure.subplots(rows, columns, sharex="row", sharey="row", squeeze=False)
    edges = left / width, bottom / tall, 1 - right / width, 1 - top / tall
    figure.subplots_adjust(*edges, wspace=0.12, hspace=gap / height)
    return figure, grid


def _faint(axes: Axes, row: xr.Dataset, average: str, label: str, **line: Any) -> None:
    """A curve to compare with, if the row has one."""
    curve = EntropyCurve.of(row, average)
    if curve:
        axes.plot(curve.amplitude, curve.value, label=label, **line)


def _points(axes: Axes, curve: EntropyCurve, average: str, size: float) -> None:
    pale = tuple(0.5 + 0.5 * np.array(to_rgb(COLOURS[average])))
    axes.errorbar(
        curve.amplitude, curve.value, curve.error, fmt="o-", color=COLOURS[average], ecolor=pale, ms=size, mew=0,
        lw=0.6, elinewidth=0.4, capsize=1.0, capthick=0.4, label=f"{AVERAGES[average]}, ± std over the cells",
    )  # fmt: skip


def _log_panel(axes: Axes, curve: EntropyCurve, average: str, size: float, fontsize: float) -> None:
    """The curve in logarithms, the power law as a thick black line with both adjusted R^2."""
    _points(axes, curve, average, size)
    x, y = curve.power_law()
    if len(x):
        axes.plot(x, y, color=style.BLACK, lw=2.0, zorder=4, label="power law, adjusted R² (of nonlinear fit)")
        fit = curve.fit
        text = f"$A^{{{fit['exponent']:.2f}}}$\n$R^2$ {fit['r2_log_log']:.3f} ({fit['r2_nonlinear']:.3f})"
        axes.text(0.04, 0.97, text, transform=axes.transAxes, ha="left", va="top", fontsize=fontsize)
    else:
        axes.text(0.04, 0.04, "no power law", transform=axes.transAxes, fontsize=fontsize, color=style.GREY)
    axes.set(xscale="log", yscale="log", ylim=SPAN, xlim=(0.8 * curve.amplitude[0], 1.25 * curve.amplitude[-1]))
