"""Mean wavenumber entropy against amplitude, for every configuration, with the power laws fitted from the peak on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from vipetsc.case.sweep import coordinate
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.series import AMPLITUDE, counted, in_pi, reading_of, suffix
from vipetsc.figures.study import Study
from vipetsc.io.ensemble_file import EnsembleFile

AVERAGES = {"energy_weighted": "energy-weighted", "masked": "masked", "joint": "joint"}
COLOURS = {"energy_weighted": style.BLUE, "masked": style.VERMILION, "joint": style.GREEN}
LOW, HIGH = 0.01, 1.0  # what a normalised curve runs between
LABELS = 5  # most labels of the legend: three averages, another reading, the power law
FACETS = ("reading", "wavenumber")
SPAN = 4e-3, 40.0  # of the logarithmic axes: room for what is written above the peak


@dataclass(frozen=True)
class Curve:
    """One configuration's mean entropy over ``amplitude`` in N, normalised to [.01, 1], and its power law.

    ``error`` is the deviation over the cells on the same scale; ``fit`` what ``/fits`` says of the curve.
    """

    amplitude: np.ndarray
    value: np.ndarray
    error: np.ndarray
    fit: dict[str, float]

    @cached_property
    def law(self) -> tuple[np.ndarray, np.ndarray]:
        """Amplitudes from the peak on and the log-log line there; empty without a fit."""
        if not np.isfinite(self.fit["factor"]):
            return np.zeros(0), np.zeros(0)
        x = self.amplitude[self.amplitude >= self.fit["peak_amplitude"] * (1 - 1e-9)]
        return x, self.fit["factor"] * x ** self.fit["exponent"]


class Curves:
    """The entropy curves of an ensemble by reading, wavenumber and configuration (all other axes together)."""

    def __init__(self, ensemble: EnsembleFile) -> None:
        self.ensemble = ensemble
        self.along = ensemble.dimensions.index(AMPLITUDE)
        order = np.argsort(ensemble.values(AMPLITUDE), kind="stable")
        self.order, self.amplitude = order, ensemble.values(AMPLITUDE)[order]

    @staticmethod
    def there(ensemble: EnsembleFile, name: str = "entropy/energy_weighted") -> bool:
        """Whether ``ensemble`` holds ``name`` at four amplitudes or more: fewer show neither peak nor power law."""
        amplitudes = AMPLITUDE in ensemble.dimensions and len(ensemble.values(AMPLITUDE)) >= 4
        return amplitudes and name in ensemble

    @cached_property
    def others(self) -> tuple[str, ...]:
        """The dimensions besides the amplitude."""
        return tuple(d for d in self.ensemble.dimensions if d != AMPLITUDE)

    def facets(self) -> list[tuple[int, ...]]:
        """Places (reading, wavenumber); 0 for an axis that is not there."""
        return list(np.ndindex(*(len(self.ensemble.values(n)) if n in self.others else 1 for n in FACETS)))

    def places(self, facet: tuple[int, ...]) -> list[tuple[int, ...]]:
        """Places on ``others`` of the configurations of a facet."""
        lengths = [1 if d in FACETS else len(self.ensemble.values(d)) for d in self.others]
        fixed = [facet[FACETS.index(d)] if d in FACETS else 0 for d in self.others]
        return [tuple(int(i + f) for i, f in zip(place, fixed, strict=True)) for place in np.ndindex(*lengths)]

    def full(self, place: tuple[int, ...]) -> tuple[int, ...]:
        """``place`` on all dimensions, at the first amplitude."""
        return (*place[: self.along], 0, *place[self.along :])

    def row(self, name: str, place: tuple[int, ...]) -> np.ndarray:
        """Dataset ``name`` over rising amplitude (and its own axes) at a place on ``others``."""
        data = self.ensemble.file[name]
        return data[(*place[: self.along], slice(None), *place[self.along :])][self.order]

    def curve(self, average: str, place: tuple[int, ...]) -> Curve | None:
        """The curve of an average; None where fewer than two members came out, or all alike."""
        value, error = self.row(f"entropy/{average}", place), self.row("entropy/error", place)
        there = np.isfinite(value)
        if there.sum() < 2 or np.ptp(value[there]) == 0:
            return None
        least, span = value[there].min(), np.ptp(value[there])
        fits = self.ensemble.file[f"fits/entropy/{average}"]
        names = ("factor", "exponent", "peak_amplitude", "r2_log_log", "r2_nonlinear")
        scale = (HIGH - LOW) / span
        return Curve(
            self.amplitude[there],
            LOW + scale * (value[there] - least),
            scale * error[there],
            {name: float(fits[name][place]) for name in names},
        )

    def silence(self, average: str, place: tuple[int, ...]) -> str:
        """Why there is no curve: members are missing, or all are the linear wave."""
        there = np.isfinite(self.row(f"entropy/{average}", place))
        return "no members" if there.sum() < 2 else "nothing touches"

    def words(self, place: tuple[int, ...]) -> str:
        """A configuration in words: 5 sites."""
        parts = []
        for name, index in zip(self.others, place, strict=True):
            value = self.ensemble.values(name)[index]
            if name not in FACETS:
                parts.append(counted(value, "site") if name == "sites" else f"{name} {value}")
        return ", ".join(parts) or "all members"

    def reading(self, place: tuple[int, ...]) -> str:
        """The reading of the members at a place."""
        if "reading" not in self.others:
            return reading_of(self.ensemble)
        return str(self.ensemble.values("reading")[place[self.others.index("reading")]])

    def wavenumber(self, place: tuple[int, ...]) -> str:
        """The drive's wavenumber as a fraction of pi; empty if the sweep drives by frequency."""
        if "wavenumber" in self.others:
            return f"κ* = {in_pi(self.ensemble.values('wavenumber')[place[self.others.index('wavenumber')]])}"
        shared = self.ensemble.sweep.table.get("drive", {}).get("wavenumber")
        return "" if shared is None else f"κ* = {in_pi(coordinate([shared])[0])}"

    def title(self, place: tuple[int, ...], wave: bool = True) -> str:
        """The sweep, its reading and wavenumber in words."""
        words = f"{self.reading(place)} reading", self.wavenumber(place) if wave else ""
        return f"{self.ensemble.sweep.name}: {', '.join(filter(None, words))}"

    def elsewhere(self, place: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        """The same place in the other readings."""
        if "reading" in self.others:
            at = self.others.index("reading")
            for i in range(len(self.ensemble.values("reading"))):
                if i != place[at]:
                    yield (*place[:at], i, *place[at + 1 :])


def measured(study: Study) -> Iterator[tuple[Curves, bool]]:
    """The ensembles that have entropies, and whether their pictures need the sweep's name."""
    found = [e for e in study.ensembles if Curves.there(e)]
    for ensemble in found:
        yield Curves(ensemble), len(found) > 1


def entropy(study: Study) -> Iterator[Drawing]:
    """Entropy against amplitude for each reading, wavenumber and average: linear above, log-log with fits below."""
    for curves, named in measured(study):
        for facet in curves.facets():
            places = curves.places(facet)
            for average in AVERAGES:
                if any(curves.curve(average, place) for place in places):
                    name = stem(curves, places[0], named, FACETS)
                    yield f"{name}-{average}", partial(_entropy, curves, places, average)


def stem(curves: Curves, place: tuple[int, ...], named: bool, kept: tuple[str, ...]) -> str:
    """The suffix of a figure of curves that share the dimensions ``kept``."""
    return suffix(curves.ensemble, curves.full(place), named, kept)


def _entropy(curves: Curves, places: list[tuple[int, ...]], average: str) -> Figure:
    figure, grid = _panels(2, len(places), 1.42, 0.38, LABELS)
    _head(figure, f"{curves.title(places[0])}, {AVERAGES[average]} mean entropy")
    for column, place in enumerate(places):
        upper, lower = grid[:, column]
        style.letter(upper, curves.words(place))
        curve = curves.curve(average, place)
        if curve is None:
            style.say(upper, curves.silence(average, place))
            style.say(lower, "")
            continue
        _others(upper, curves, average, place)
        for axes in (upper, lower):
            _points(axes, curve, COLOURS[average], AVERAGES[average])
        for other in curves.elsewhere(place):
            beside = curves.curve(average, other)
            if beside:
                label = f"{curves.reading(other)} reading"
                lower.plot(beside.amplitude, beside.value, color=style.GREY, lw=0.7, ls=(0, (3, 1.5)), label=label)
        _law(lower, curve, 6.0)
        upper.set(xlim=(0, 1.04 * curve.amplitude[-1]), ylim=(-0.05, 1.45))
        _logarithmic(lower, curve)
    grid[0, 0].set_ylabel("Normalised entropy")
    grid[1, 0].set_ylabel("Normalised entropy")
    for axes in grid[1]:
        axes.set_xlabel("A (N)")
    pairs = [pair for axes in grid.flat for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    handles = {label: handle for handle, label in pairs}
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=_legend_columns(len(places)))
    return figure


def _legend_columns(columns: int) -> int:
    return 3 if columns > 4 else 2


def _panels(rows: int, columns: int, height: float, gap: float = 0.1, labels: int = 0) -> tuple[Figure, np.ndarray]:
    """A grid of panels of ``height`` inches, ``gap`` apart, and room for a legend of so many ``labels``.

    Laid out by hand, since fitting dozens of panels takes long.
    """
    left, right, top, bottom = 0.52, 0.06, 0.45, 0.42 + 0.15 * -(-labels // _legend_columns(columns))
    width = style.PAGE * max(columns, 4) / 6
    tall = top + bottom + rows * height + (rows - 1) * gap
    figure = style.new_figure(width, tall, fitted=False)
    grid = figure.subplots(rows, columns, sharex="row", sharey="row", squeeze=False)
    edges = left / width, bottom / tall, 1 - right / width, 1 - top / tall
    figure.subplots_adjust(*edges, wspace=0.12, hspace=gap / height)
    return figure, grid


def _head(figure: Figure, text: str) -> None:
    figure.suptitle(text, fontsize=8, y=1 - 0.05 / figure.get_figheight(), va="top")


def _others(axes: Axes, curves: Curves, average: str, place: tuple[int, ...]) -> None:
    """The other averages as faint lines."""
    for name, words in AVERAGES.items():
        other = curves.curve(name, place) if name != average else None
        if other:
            axes.plot(other.amplitude, other.value, color=COLOURS[name], lw=0.6, alpha=0.5, label=words)


def _points(axes: Axes, curve: Curve, colour: str, label: str, size: float = 2.2) -> None:
    pale = tuple(0.5 + 0.5 * np.array(to_rgb(colour)))
    axes.errorbar(
        curve.amplitude, curve.value, curve.error, fmt="o-", color=colour, ecolor=pale, ms=size, mew=0, lw=0.6,
        elinewidth=0.4, capsize=1.0, capthick=0.4, label=f"{label}, ± std over the cells",
    )  # fmt: skip


def _law(axes: Axes, curve: Curve, fontsize: float) -> None:
    """The power law as a thick black line, and both adjusted R^2."""
    x, y = curve.law
    if not len(x):
        axes.text(0.04, 0.04, "no power law", transform=axes.transAxes, fontsize=fontsize, color=style.GREY)
        return
    axes.plot(x, y, color=style.BLACK, lw=2.0, zorder=4, label="power law, adjusted R² (of nonlinear fit)")
    fit = curve.fit
    text = f"$A^{{{fit['exponent']:.2f}}}$\n$R^2$ {fit['r2_log_log']:.3f} ({fit['r2_nonlinear']:.3f})"
    axes.text(0.04, 0.97, text, transform=axes.transAxes, ha="left", va="top", fontsize=fontsize)


def _logarithmic(axes: Axes, curve: Curve) -> None:
    axes.set(xscale="log", yscale="log", ylim=SPAN)
    axes.set_xlim(0.8 * curve.amplitude[0], 1.25 * curve.amplitude[-1])


def entropy_all(study: Study) -> Iterator[Drawing]:
    """Every wavenumber (rows) and configuration (columns), log-log, with fits and both adjusted R^2."""
    for curves, named in measured(study):
        facets = curves.facets()
        for reading in sorted({facet[0] for facet in facets}):
            rows = [curves.places(facet) for facet in facets if facet[0] == reading]
            if len(rows) < 2:
                continue
            for average in AVERAGES:
                if any(curves.curve(average, place) for row in rows for place in row):
                    name = stem(curves, rows[0][0], named, ("reading",))
                    yield f"{name}-{average}", partial(_entropy_all, curves, rows, average)


def _entropy_all(curves: Curves, rows: list[list[tuple[int, ...]]], average: str) -> Figure:
    figure, grid = _panels(len(rows), len(rows[0]), 1.15)
    _head(figure, f"{curves.title(rows[0][0], False)}, {AVERAGES[average]} mean entropy")
    for r, row in enumerate(rows):
        for c, place in enumerate(row):
            axes, curve = grid[r, c], curves.curve(average, place)
            if r == 0:
                style.letter(axes, curves.words(place))
            if curve is None:
                style.say(axes, curves.silence(average, place))
                continue
            _points(axes, curve, COLOURS[average], AVERAGES[average], 1.6)
            _law(axes, curve, 5.5)
            _logarithmic(axes, curve)
        grid[r, 0].set_ylabel(curves.wavenumber(row[0]))
        for axes in grid[r]:
            axes.tick_params(labelbottom=r == len(rows) - 1)
    for axes in grid[-1]:
        axes.set_xlabel("A (N)")
    return figure
