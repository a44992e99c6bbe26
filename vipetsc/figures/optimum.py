"""A search for the best design: its progress, the compared designs, and their performance over the amplitude."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vipetsc.case.nfrc import RESPONSE
from vipetsc.case.optimise import ObjectiveTable, OptimiseCase
from vipetsc.figures import style
from vipetsc.figures.page import Page
from vipetsc.figures.series import Series
from vipetsc.spectra.measures import row_of
from vipetsc.wording import with_unit

# Markers of compared designs, in the order of drawing.
MARKERS = {"case": "s", "best-1": "^", "best": "o", "best-2": "v"}
SYMBOLS = {
    "upper_share_at_end": "upper bands at the end / work",
    "transmitted": "energy beyond the last site / work",
    "ibtet": "ibtet",
    "entropy": "entropy (bit)",
}
MOST_LINES = 12  # variables whose names have the usual size; names of more would touch


class ComparedDesign(NamedTuple):
    """A design that a search compares with others: its ``name``, and its ``number`` among all, from 0."""

    name: str
    number: int


def _label(objective: ObjectiveTable) -> str:
    """Return what an objective measures, with its unit, as the label of an axis."""
    if objective.is_of_responses:
        return _of_responses(objective.name)
    if objective.is_of_runs:
        _, unit, _ = row_of(str(objective.measure))
        return with_unit(objective.name, unit)
    part = f", {objective.part[0]:g}-{objective.part[1]:g} rad/s" if objective.part else ""
    return SYMBOLS.get(objective.measure, f"band {objective.band}{part} at the end / work")


def _of_responses(name: str) -> str:
    """Return the ``name`` of a quantity of responses in words, as "peak displacement of mass"."""
    quantity, _, place = name.replace(RESPONSE, "").partition("/")
    return " of ".join(filter(None, [quantity.replace("_", " "), place]))


def _misses_constraint(optimum: xr.Dataset) -> np.ndarray:
    """Return whether each design misses a constraint."""
    if "excess" not in optimum:
        return np.zeros(optimum.sizes["design"], bool)
    return np.asarray(optimum["excess"].values > 0)


def _compared(optimum: xr.Dataset) -> list[ComparedDesign]:
    """Return the compared designs in the order of drawing, so that the best one lies on top, each once."""
    numbers = dict(zip(optimum["compared"].values, optimum["comparison/number"].values.tolist(), strict=True))
    best = numbers.get("best")
    compared = []
    for name in MARKERS:
        # A design that has two names, as the case has if no design is better, is shown as "best".
        if name in numbers and (name == "best" or numbers[name] != best):
            compared.append(ComparedDesign(name, numbers[name]))
    return compared


def convergence(optimum: xr.Dataset) -> Figure:
    """Draw the values of all designs: one objective in the designs' order, or two over each other.

    If they come from runs, there is a panel with the energies of the upper bands and the losses.
    """
    plan = OptimiseCase.of(optimum)
    options = plan.options
    objectives = options.objective
    sought = [objective.describe(plan.amplitude_unit) for objective in objectives]
    sought += [constraint.describe(plan.amplitude_unit) for constraint in options.constraint or []]
    page = Page.of(columns=1 + options.measures_runs, width=style.PAGE, height=2.8, heading="; ".join(sought))
    values, *others = page.panels
    if len(objectives) == 1:
        _draw_one_objective(values, optimum, objectives[0])
    else:
        _draw_two_objectives(values, optimum, objectives[0], objectives[1])
    values.legend(loc="best", fontsize=6)

    for axes in others:
        _draw_fractions(axes, optimum)
    return page.lettered()


def _draw_fractions(axes: Axes, optimum: xr.Dataset) -> None:
    """Draw the energies of the upper bands and the losses of all designs."""
    number = optimum["design"].values
    for name in ("upper_share_at_end", "dissipated"):
        look = {"ms": 3, "label": name.replace("_", " "), **style.CURVES[f"designs/{name}"]}
        axes.plot(number, optimum[name].values, ".", **look)
    axes.set(xlabel="Design", ylabel="fraction of the work, mean", ylim=(0, None), title="All designs")
    axes.legend(loc="best")


def _draw_one_objective(axes: Axes, optimum: xr.Dataset, objective: ObjectiveTable) -> None:
    """Draw the objective over the designs in their order, the best so far, and the designs that failed."""
    number = optimum["design"].values
    value = optimum["value"].values[:, 0]
    best = np.fmax if objective.goal == "maximise" else np.fmin
    misses = _misses_constraint(optimum)
    axes.plot(number[~misses], value[~misses], ".", color=style.SKY, ms=3, label="designs")
    if misses.any():
        axes.plot(number[misses], value[misses], ".", color=style.GREY, ms=3, label="miss a constraint")
    axes.step(
        number,
        best.accumulate(np.where(misses, np.nan, value)),
        where="post",
        color=style.BLACK,
        lw=0.8,
        label="best so far",
    )

    failed = optimum["reason"].values != ""
    if failed.any():
        # Designs that failed have no value: they are marked on the lower edge of the panel.
        look = {"color": style.RED, "ms": 3, "clip_on": False, "label": "failed"}
        axes.plot(number[failed], np.zeros(failed.sum()), "x", transform=axes.get_xaxis_transform(), **look)
    axes.set(xlabel="Design", ylabel=_label(objective), title="Objective")
    for design in _compared(optimum):
        _mark(axes, design, design.number, value[design.number])


def _draw_two_objectives(axes: Axes, optimum: xr.Dataset, first: ObjectiveTable, second: ObjectiveTable) -> None:
    """Draw one objective over the other, later designs darker, and the Pareto front."""
    number = optimum["design"].values
    value = optimum["value"].values
    # The scale of colours begins at a negative number: at 0 the first designs would be white.
    shades = {"c": number, "cmap": "Blues", "vmin": -0.5 * len(number)}
    axes.scatter(value[:, 0], value[:, 1], s=6, label="designs (later: darker)", **shades)
    misses = _misses_constraint(optimum)
    if misses.any():
        axes.plot(*value[misses].T, "x", color=style.GREY, ms=3, label="miss a constraint")
    front = value[optimum["front"].values]
    axes.plot(front[:, 0], front[:, 1], color=style.BLACK, lw=0.8, label="front")
    axes.set(xlabel=f"{first.goal} {_label(first)}", title="Both objectives")
    axes.set_ylabel(f"{second.goal} {_label(second)}")
    for design in _compared(optimum):
        _mark(axes, design, *value[design.number])


def _mark(axes: Axes, design: ComparedDesign, x: float, y: float) -> None:
    """Draw the marker of a compared design at ``x`` and ``y``; the legend has its name and number."""
    look = {**style.CURVES[design.name], "mec": "white", "mew": 0.5, "ms": 6}
    axes.plot(x, y, MARKERS[design.name], label=f"{design.name} ({design.number})", **look)


def compared_designs(optimum: xr.Dataset) -> Figure:
    """Draw the compared designs: clearances over the cells of the sites, and each variable between its bounds."""
    plan = OptimiseCase.of(optimum)
    page = Page.of(columns=2, height=2.6)
    sites, variables = page.panels
    for i, design in enumerate(_compared(optimum)):
        row = optimum.sel(compared=design.name)
        look = {"marker": MARKERS[design.name], **style.CURVES[design.name]}
        clearance = 1e3 * row["comparison/clearance"].values
        Series(row["comparison/cell"].values, clearance, {"lw": 0.5, "ms": 4, **look}, design.name).draw(sites)

        # A little apart, so that designs of equal values are all seen.
        position = plan.space.to_unit(optimum["parameter"].values[int(row["comparison/number"])])
        variables.plot(position, np.arange(len(position)) + 0.12 * i, ls="", ms=3.5, **look)
    sites.set(xlabel="Cell", ylabel="Clearance (mm)", ylim=(0, None), title="Sites")
    sites.xaxis.set_major_locator(MaxNLocator(integer=True))
    sites.legend(loc="best")

    names = optimum["variable"].values
    variables.set(xlim=(-0.02, 1.02), xlabel="between its bounds", title="What varies", ylim=(len(names) - 0.3, -0.7))
    variables.set_yticks(np.arange(len(names)), names, fontsize=6 if len(names) > MOST_LINES else None)
    variables.grid(axis="y", color=style.PALE, lw=0.5)
    return page.lettered()


def compared_curves(optimum: xr.Dataset) -> Figure:
    """Draw what the objectives measure of the compared designs, over the amplitude or along responses; and energies."""
    plan = OptimiseCase.of(optimum)
    # Objectives that measure the same at different amplitudes have one panel, with the curve of the last of them.
    measures = {objective.name: i for i, objective in enumerate(plan.options.objective)}
    has_energies = plan.options.measures_runs
    page = Page.of(columns=len(measures) + has_energies, width=style.PAGE, height=2.6)
    for axes, i in zip(page.panels, measures.values(), strict=False):
        if plan.options.objective[i].is_of_responses:
            _draw_response(axes, optimum, plan, i)
        else:
            _draw_measure(axes, optimum, plan, i)
    page.panels[0].legend(loc="best")
    if has_energies:
        _draw_energies(page.panels[-1], optimum, plan)
    return page.lettered()


def _draw_response(axes: Axes, optimum: xr.Dataset, plan: OptimiseCase, index: int) -> None:
    """Draw the frequency responses from which objective number ``index`` is taken."""
    objective = plan.options.objective[index]
    of_line = optimum["response/of"].values
    lines = optimum["response/compared"].values
    for design in _compared(optimum):
        label = design.name
        for line in np.flatnonzero(lines == design.name):
            points = np.flatnonzero(of_line == line)
            parameter = optimum["response/parameter"].values[points]
            value = optimum["response/value"].values[points, index]
            unstable = optimum["response/unstable"].values[points]
            look = {"lw": 1.2, **style.CURVES[design.name]}
            Series(parameter, value, look, label, unstable=unstable, thin={"lw": 0.4, "ls": "-"}).draw(axes)
            # Of several curves of a design the first one is named.
            label = "_"

    for bound in objective.part or []:
        axes.axvline(bound, color=style.GREY, lw=0.5, ls=style.DOTTED)
    if objective.below:
        axes.axhline(objective.below, color=style.GREY, lw=0.5, ls=style.DASHED)
    case = plan.responses(plan.base)
    unit = case.measures()[str(objective.measure)].unit
    label = _of_responses(str(objective.measure))
    over = case.nfrc.over.capitalize()
    if case.nfrc.over == "frequency":
        over += " (rad/s)"
    axes.set_xlabel(over)
    title = "Responses (thin: unstable)"
    if np.any(optimum["response/unstable"].values < 0):
        title = "Responses (thin: unstable; x: undecided)"
    axes.set_title(title)
    axes.set_ylabel(with_unit(label, unit))


def _draw_measure(axes: Axes, optimum: xr.Dataset, plan: OptimiseCase, index: int) -> None:
    """Draw what objective number ``index`` measures over the amplitude's size, and the sizes that were searched."""
    objectives = plan.options.objective
    objective = objectives[index]
    # The sign of a drive's amplitude is a phase, for which a logarithmic axis has no place.
    sizes = np.abs(optimum["amplitude"].values)
    order = np.argsort(sizes, kind="stable")
    for design in _compared(optimum):
        values = optimum["curve/value"].sel(compared=design.name).values[:, index]
        look = {"marker": MARKERS[design.name], "lw": 0.8, "ms": 3, **style.CURVES[design.name]}
        Series(sizes[order], values[order], look, design.name).draw(axes)

    searched = set()
    for other in objectives:
        if other.name == objective.name:
            searched.update(other.amplitudes or [abs(plan.amplitude)])
    for amplitude in searched:
        axes.axvline(amplitude, color=style.GREY, lw=0.5, ls=style.DOTTED)
    axes.set(
        xscale="log",
        xlabel=f"Amplitude ({plan.amplitude_unit})",
        ylabel=_label(objective),
        title="dotted: amplitudes of the search",
    )


def _draw_energies(axes: Axes, optimum: xr.Dataset, plan: OptimiseCase) -> None:
    """Draw bars of the energy in every band, and what was lost, of each design at the case's amplitude, or near it."""
    amplitudes = optimum["amplitude"].values
    # Nearest by the ratio of sizes, since amplitudes of a curve are spaced in logarithms, and may differ in sign.
    nearest = int(np.argmin(np.abs(np.log(np.abs(amplitudes / plan.amplitude)))))
    labels = [*(f"band {band}" for band in optimum["band"].values), "lost"]

    designs = _compared(optimum)
    width = 0.8 / len(designs)
    for i, design in enumerate(designs):
        row = optimum.sel(compared=design.name)
        energies = [*row["curve/bands"].values[nearest], row["curve/dissipated"].values[nearest]]
        x = np.arange(len(energies)) + (i - (len(designs) - 1) / 2) * width
        axes.bar(x, energies, width, **style.CURVES[design.name])
    axes.set_xticks(np.arange(len(labels)), labels)
    axes.set(ylabel="fraction of the work at the end", title=f"At {amplitudes[nearest]:.4g} {plan.amplitude_unit}")
