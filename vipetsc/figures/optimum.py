"""A search for the best design: how it went, the designs it compares, what they do over the amplitude."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.figures import style

COLOURS = {"case": style.GREY, "best-1": style.VERMILION, "best": style.BLUE, "best-2": style.GREEN}
MARKERS = {"case": "s", "best-1": "^", "best": "o", "best-2": "v"}
SYMBOLS = {
    "upper_share_at_end": "upper bands at the end / work",
    "transmitted": "energy beyond the last site / work",
    "ibtet": "ibtet",
    "entropy": "entropy (bit)",
}


def _label(objective: ObjectiveTable) -> str:
    """What an objective measures, for an axis."""
    part = f", {objective.part[0]:g}-{objective.part[1]:g} rad/s" if objective.part else ""
    return SYMBOLS.get(objective.measure, f"band {objective.band}{part} at the end / work")


def _compared(optimum: xr.Dataset) -> list[str]:
    """The names of the compared designs, once each; what is drawn last lies on top."""
    numbers = dict(zip(optimum["compared"].values, optimum["comparison/number"].values.tolist(), strict=True))
    return [name for name in COLOURS if name in numbers and (name == "best" or numbers[name] != numbers.get("best"))]


def convergence(optimum: xr.Dataset) -> Figure:
    """The values of all designs, in their order or over both objectives, and what else became of them."""
    objectives, number = OptimiseCase.of(optimum).options.objective, optimum["design"].values
    value, failed = optimum["value"].values, optimum["reason"].values != ""
    figure = style.new_figure(style.PAGE, 2.8, "; ".join(objective.describe() for objective in objectives))
    left, right = figure.subplots(1, 2)
    compared = {name: int(optimum["comparison/number"].sel(compared=name)) for name in _compared(optimum)}
    if len(objectives) == 1:
        best = np.fmax if objectives[0].goal == "maximise" else np.fmin
        left.plot(number, value[:, 0], ".", color=style.SKY, ms=3, label="designs")
        left.step(number, best.accumulate(value[:, 0]), where="post", color=style.BLACK, lw=0.8, label="best so far")
        places = {name: (at, value[at, 0]) for name, at in compared.items()}
        if failed.any():
            look = {"color": style.RED, "ms": 3, "clip_on": False, "label": "failed"}
            left.plot(number[failed], np.zeros(failed.sum()), "x", transform=left.get_xaxis_transform(), **look)
        left.set(xlabel="Design", ylabel=_label(objectives[0]), title="Objective")
    else:
        left.scatter(*value.T, c=number, cmap="Blues", s=6, vmin=-0.5 * len(number), label="designs (later: darker)")
        left.plot(*value[optimum["front"].values].T, color=style.BLACK, lw=0.8, label="front")
        places = {name: tuple(value[at]) for name, at in compared.items()}
        left.set(xlabel=f"{objectives[0].goal} {_label(objectives[0])}", title="Both objectives")
        left.set_ylabel(f"{objectives[1].goal} {_label(objectives[1])}")
    for name, place in places.items():
        left.plot(
            *place, MARKERS[name], color=COLOURS[name], mec="white", mew=0.5, ms=6, label=f"{name} ({compared[name]})"
        )
    left.legend(loc="best", fontsize=6)
    for name, colour in (("upper_share_at_end", style.PURPLE), ("dissipated", style.ORANGE)):
        right.plot(number, optimum[name].values, ".", color=colour, ms=3, label=name.replace("_", " "))
    right.set(xlabel="Design", ylabel="share of the work, mean", ylim=(0, None), title="All designs")
    right.legend(loc="best")
    return figure


def compared_designs(optimum: xr.Dataset) -> Figure:
    """Clearances over the cells of the sites, and where within its bounds all that varies lies."""
    plan, names = OptimiseCase.of(optimum), _compared(optimum)
    figure = style.new_figure(style.PAGE, 2.6)
    left, right = figure.subplots(1, 2)
    for shift, name in enumerate(names):
        row = optimum.sel(compared=name)
        cells, gaps = row["comparison/cell"].values, 1e3 * row["comparison/clearance"].values
        left.plot(cells, gaps, MARKERS[name] + "-", color=COLOURS[name], lw=0.5, ms=4, label=name)
        place = plan.to_unit(optimum["parameter"].values[int(row["comparison/number"])])
        right.plot(place, np.arange(len(place)) + 0.12 * shift, MARKERS[name], color=COLOURS[name], ms=3.5)
    left.set(xlabel="Cell", ylabel="Clearance (mm)", ylim=(0, None), title="Sites")
    left.legend(loc="best")
    variables = optimum["variable"].values
    right.set(xlim=(-0.02, 1.02), xlabel="between its bounds", title="What varies", ylim=(len(variables) - 0.3, -0.7))
    right.set_yticks(np.arange(len(variables)), variables, fontsize=6 if len(variables) > 12 else None)
    right.grid(axis="y", color=style.PALE, lw=0.5)
    return figure


def compared_curves(optimum: xr.Dataset) -> Figure:
    """What the objectives measure over the amplitude, and the band energies, of the compared designs."""
    plan, names = OptimiseCase.of(optimum), _compared(optimum)
    objectives, amplitude = plan.options.objective, optimum["amplitude"].values
    measures = {objective.name: (i, objective) for i, objective in enumerate(objectives)}
    figure = style.new_figure(style.PAGE, 2.6)
    panels: list[Axes] = list(figure.subplots(1, len(measures) + 1, squeeze=False)[0])
    for axes, (i, objective) in zip(panels, measures.values(), strict=False):
        for name in names:
            curve = optimum["curve/value"].sel(compared=name).values[:, i]
            axes.plot(amplitude, curve, MARKERS[name] + "-", color=COLOURS[name], lw=0.8, ms=3, label=name)
        for at in {
            a for o in objectives if o.name == objective.name for a in o.amplitudes or [plan.base.drive.amplitude]
        }:
            axes.axvline(at, color=style.GREY, lw=0.5, ls=style.DOTTED)
        axes.set(xscale="log", xlabel="Amplitude (N)", ylabel=_label(objective), title="dotted: amplitudes searched")
    panels[0].legend(loc="best")
    at = int(np.argmin(np.abs(np.log(amplitude / plan.base.drive.amplitude))))
    bands = optimum["band"].values
    labels, width = [*(f"band {band}" for band in bands), "lost"], 0.8 / len(names)
    for shift, name in enumerate(names):
        row = optimum.sel(compared=name)
        shares = [*row["curve/bands"].values[at], row["curve/dissipated"].values[at]]
        places = np.arange(len(shares)) + (shift - (len(names) - 1) / 2) * width
        panels[-1].bar(places, shares, width, color=COLOURS[name])
    panels[-1].set_xticks(np.arange(len(labels)), labels)
    panels[-1].set(ylabel="share of the work at the end", title=f"At {amplitude[at]:.4g} N")
    return figure
