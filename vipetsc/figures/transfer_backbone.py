"""Inter-band transfer against normalised energy, the slope of a branch over it (paper, Figs. 12, S7 and S8)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.panels import panel_title, shade_regions
from vipetsc.figures.study import Study, configuration_heading, configuration_stem, grouped, law_name
from vipetsc.io.netcdf import open_netcdf

RED = "#CC0000"


class AlignedCurve(NamedTuple):
    """A transfer curve in the energies of a branch: a group of ``backbone.h5``, its values and attributes by name."""

    case: Case
    values: dict[str, Any]


def ibtet_backbone(study: Study) -> Iterator[Drawing]:
    """Every reading and configuration of ``backbone.h5``, laws in columns; one made of another sweep is passed over."""
    for ensemble in study.ensembles:
        path = Path(ensemble.attrs["folder"]) / "backbone.h5"
        if path.exists():
            aligned = _read(path, ensemble.attrs["case"])
            for name, columns in grouped(aligned, lambda curve: configuration_stem(curve.case)).items():
                yield name, partial(_page, sorted(columns, key=lambda c: c.case.contacts.law, reverse=True))


def _read(path: Path, sweep: str) -> list[AlignedCurve]:
    """The curves in ``path``; none if it was made of another sweep than that of the case file's text ``sweep``."""
    with open_netcdf(path, "backbone", ("case",)) as file:
        if file.attrs["case"] != sweep:
            return []
        groups: dict[str, dict[str, Any]] = {}
        for name, value in [*file.attrs.items(), *((n, v.values) for n, v in file.variables.items())]:
            group, _, rest = str(name).partition("/")
            if rest:
                groups.setdefault(group, {})[rest] = value
    return [AlignedCurve(Case.from_toml(values["case"]), values) for values in groups.values()]


def _page(columns: Sequence[AlignedCurve]) -> Figure:
    width = style.PAGE if len(columns) > 1 else 4.0
    figure = style.new_figure(width, 3.0, configuration_heading(columns[0].case), left=True)
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for i, (axes, (case, values)) in enumerate(zip(panels, columns, strict=True)):
        _superposition(axes, values)
        reading = values["branch_reading"]
        panel_title(axes, f"({'abcdef'[i]}) {law_name(case)}; branch of the {reading} reading")
    panels[0].set_ylabel("Inter-band transfer, normalised slope (1)")
    return figure


def _superposition(axes: Axes, curve: dict[str, Any]) -> None:
    """Points of the lattice, red where fitted; slope over the divisor dashed, with the floor grey; the law green."""
    energy, transfer, fitted = curve["energy"], curve["ibtet"], curve["fitted"].astype(bool)
    branch, slope, region = (curve[f"branch/{name}"] for name in ("energy", "slope", "region"))
    grazing, floor = curve["grazing_energy"], curve["floor"]
    scaled = np.where(region == 1, 0.0, np.abs(slope)) / curve["divisor"]
    left = 0.5 * min(energy.min(), 0.1 * grazing)
    # Region I goes on to the left: below the first point of the branch its slope is zero as well.
    with_floor = np.append(left, branch), floor + np.append(0.0, scaled)
    axes.plot(*with_floor, color=style.GREY, lw=2.2, alpha=0.55, label="slope + floor")
    label = f"slope, $E^{{{curve['slope_exponent']:.2f}}}$ there"
    axes.plot(branch, np.where(scaled > 0, scaled, np.nan), color=style.BLACK, lw=0.8, ls=style.DASHED, label=label)
    axes.plot(energy, transfer, "-o", color=style.BLUE, ms=2.6, mfc="white", mew=0.6, lw=0.6, label="lattice")
    axes.plot(energy[fitted], transfer[fitted], "o", color=RED, ms=2.8, label="in region III")
    label = f"$E^{{{curve['exponent']:.2f}}}$, adj. $R^2$ {curve['r2_adjusted']:.3f}"
    law = curve["factor"] * energy[fitted] ** curve["exponent"]
    axes.plot(energy[fitted], law, color=style.GREEN, lw=1.4, zorder=4, label=label)
    right = 2 * energy.max()
    shade_regions(axes, np.minimum(np.where(region == 1, grazing, branch), right), region, left, at_top=False)
    axes.set(xscale="log", yscale="log", xlabel="Normalised energy (J)", xlim=(left, right), ylim=(0.25 * floor, 4.0))
    axes.legend(loc="upper right", fontsize=6)
