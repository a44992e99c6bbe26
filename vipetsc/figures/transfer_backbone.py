"""Inter-band transfer against normalised energy with the slope of the frequency-energy branch over it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.drawing import Drawing
from vipetsc.figures.members import configuration, configuration_stem, law_name
from vipetsc.figures.study import Study

NUMERALS = {1: "I", 2: "II", 3: "III", 4: "IV"}
SHADES = {1: "#FFFFFF", 2: "#E4E4E4", 3: "#FFFFFF", 4: "#F1F1F1"}
RED = "#CC0000"


def ibtet_backbone(study: Study) -> Iterator[Drawing]:
    """The paper's Fig. Ejump_FEP for every reading and configuration, from ``backbone.h5``; laws in columns.

    A ``backbone.h5`` that was made of another sweep is passed over.
    """
    for ensemble in study.ensembles:
        path = ensemble.folder / "backbone.h5"
        if not path.exists():
            continue
        with h5py.File(path) as file:
            if file.attrs.get("case") != ensemble.file.attrs["case"]:
                continue
            pages: dict[str, list[tuple[Case, h5py.Group]]] = {}
            for group in file.values():
                case = Case.from_toml(group.attrs["case"])
                pages.setdefault(configuration_stem(case), []).append((case, group))
            for name, columns in pages.items():
                yield name, partial(_page, columns)


def _page(columns: Sequence[tuple[Case, h5py.Group]]) -> Figure:
    columns = sorted(columns, key=lambda c: c[0].contacts.law, reverse=True)
    case, _ = columns[0]
    figure = style.new_figure(style.PAGE if len(columns) > 1 else 4.0, 3.0)
    figure.suptitle(f"{case.lattice.reading.capitalize()}, {configuration(case)}", fontsize=8, x=0.01, ha="left")
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for i, (axes, (own, group)) in enumerate(zip(panels, columns, strict=True)):
        _superposition(axes, group)
        style.letter(axes, f"({'abcdef'[i]}) {law_name(own)}; branch of the {group.attrs['branch_reading']} reading")
    panels[0].set_ylabel("Inter-band transfer, normalised slope (1)")
    return figure


def _superposition(axes: Axes, group: h5py.Group) -> None:
    """Points of the lattice, red where fitted; slope over the divisor dashed, with the floor grey; the law green."""
    about = group.attrs
    energy, ibtet, fitted = (group[n][...] for n in ("energy", "ibtet", "fitted"))
    fitted = fitted.astype(bool)
    place, steep, region = (group[f"branch/{n}"][...] for n in ("energy", "slope", "region"))
    scaled = np.where(region == 1, 0.0, np.abs(steep)) / about["divisor"]
    left = 0.5 * min(energy.min(), 0.1 * about["grazing_energy"])
    # Region I goes on to the left: below the first point of the branch its slope is zero as well.
    whole = np.append(left, place), about["floor"] + np.append(0.0, scaled)
    axes.plot(*whole, color=style.GREY, lw=2.2, alpha=0.55, label="slope + floor")
    bare, text = np.where(scaled > 0, scaled, np.nan), f"slope, $E^{{{about['slope_exponent']:.2f}}}$ there"
    axes.plot(place, bare, color=style.BLACK, lw=0.8, ls=(0, (4, 2)), label=text)
    axes.plot(energy, ibtet, "-o", color=style.BLUE, ms=2.6, mfc="white", mew=0.6, lw=0.6, label="lattice")
    axes.plot(energy[fitted], ibtet[fitted], "o", color=RED, ms=2.8, label="in region III")
    law = about["factor"] * energy[fitted] ** about["exponent"]
    exponent, adjusted = about["exponent"], about["r2_adjusted"]
    text = f"$E^{{{exponent:.2f}}}$, adj. $R^2$ {adjusted:.3f}"
    axes.plot(energy[fitted], law, color=style.GREEN, lw=1.4, zorder=4, label=text)
    axes.set(xscale="log", yscale="log", xlabel="Normalised energy (J)")
    axes.set_xlim(left, 2 * energy.max())
    axes.set_ylim(0.25 * about["floor"], 4.0)
    _regions(axes, place, region, about["grazing_energy"])
    axes.legend(loc="upper right", fontsize=6)


def _regions(axes: Axes, energy: np.ndarray, region: np.ndarray, grazing: float) -> None:
    """Shade regions I-IV and name them at the bottom; each begins where the one below it ends."""
    left, right = axes.get_xlim()
    ends = [(k, energy[region == k].max()) for k in NUMERALS if np.any(region == k)]
    low = left
    for k, high in ends:
        high = min(grazing if k == 1 else high, right)
        if high <= low:
            continue
        axes.axvspan(low, high, color=SHADES[k], lw=0, zorder=0)
        axes.text(np.sqrt(low * high), 0.015, NUMERALS[k], ha="center", va="bottom", fontsize=6.5, color=style.GREY,
                  transform=axes.get_xaxis_transform())  # fmt: skip
        low = high
    axes.set_xlim(left, right)
