"""Inter-band transfer against the amplitude (paper, Fig. 9) and against the slope of a branch (Figs. 12, S7, S8)."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.panels import label_outer, panel_title, shade_regions
from vipetsc.figures.study import AMPLITUDE, Labels, Sweeps, grouped, sites_of
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import curves

LINES = ((style.BLUE, "o"), (style.VERMILION, "s"), (style.GREEN, "^"), (style.PURPLE, "D"), (style.ORANGE, "v"))
FEWEST = 6  # amplitudes that make a curve


class Curve(NamedTuple):
    """What was measured of one law, reading and configuration, by name; ``case`` stands for its members."""

    case: Case
    data: Mapping[Any, Any]


def transfer_curves(sweeps: Sweeps) -> Iterator[Curve]:
    """The curves over rising amplitude of all sweeps with at least ``FEWEST`` amplitudes whose transfer is known.

    ``peak`` is the index of the largest "ibtet", ``floor`` the transfer without any contact, NaN if all members touch.
    """
    for ensemble in sweeps:
        for row, folder in curves(ensemble, AMPLITUDE) if "ibtet" in ensemble else ():
            case, data = Case.load(folder / "case.toml"), row.sortby(AMPLITUDE)
            transfer = data["ibtet"].values
            if sites_of(case) and np.isfinite(transfer).sum() >= FEWEST:
                untouched = transfer[data["contact_episodes"].values == 0]
                floor = untouched.mean() if untouched.size else np.nan
                yield Curve(case, data.assign(floor=floor, peak=int(np.nanargmax(transfer))))


def columns_of_laws(
    shown: Sequence[Curve], narrow: float, height: float, ylabel: str, panel: Callable[[Axes, Curve], str]
) -> Figure:
    """A page of one configuration: a column a law, drawn by ``panel``, which returns the column's title.

    A single column is ``narrow`` inches wide.
    """
    shown = sorted(shown, key=lambda curve: curve.case.contacts.law, reverse=True)
    width = style.PAGE if len(shown) > 1 else narrow
    figure = style.new_figure(width, height, Labels.of(shown[0].case).page, left=True)
    grid = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for tag, axes, curve in zip("abcdef", grid, shown, strict=False):
        panel_title(axes, f"({tag}) {panel(axes, curve)}")
    grid[0].set_ylabel(ylabel)
    return figure


def ibtet(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """One page a reading: laws in columns, linear and log-log scales in rows."""
    for reading, of_reading in grouped(transfer_curves(sweeps), lambda curve: curve.case.lattice.reading).items():
        yield reading, partial(_page, reading, of_reading)


def _page(reading: str, of_reading: Sequence[Curve]) -> Figure:
    laws = sorted({c.case.contacts.law for c in of_reading}, reverse=True)
    kinds = dict(zip(dict.fromkeys(Labels.of(c.case).configuration for c in of_reading), LINES * 5, strict=False))
    figure = style.new_figure(style.PAGE if len(laws) > 1 else style.COLUMN, 4.6)
    grid = figure.subplots(2, len(laws), sharey="row", squeeze=False)
    for column, law in enumerate(laws):
        of_law = [c for c in of_reading if c.case.contacts.law == law]
        linear, logarithmic = grid[:, column]
        for row, axes in enumerate((linear, logarithmic)):
            _draw(axes, of_law, kinds)
            panel_title(axes, f"({'ab'[column % 2]}.{row + 1}) {law.capitalize()}, {reading}")
        linear.set(xlim=(0, None), ylim=(0, None))
        logarithmic.set(xscale="log", yscale="log", ylim=(None, 6.0))
        logarithmic.legend(loc="upper right", fontsize=6)

        # The curves about their peaks: a ring round the largest value of each, and what it is.
        inset = linear.inset_axes([0.40, 0.30, 0.57, 0.64])
        _draw(inset, of_law, kinds, size=1.8)
        peaks = [tuple(float(c.data[name][c.data["peak"]]) for name in (AMPLITUDE, "ibtet")) for c in of_law]
        nearest = min(
            float(c.data[AMPLITUDE][c.data["ibtet"] > 0.1 * largest][0])
            for c, (_, largest) in zip(of_law, peaks, strict=True)
        )
        right, top = np.max(peaks, axis=0)
        inset.set(xlim=(0.0, max(10 * nearest, 2 * right)), ylim=(0, 1.18 * top))
        inset.tick_params(labelsize=6, pad=1.5)
        for line, (curve, (amplitude, largest)) in enumerate(zip(of_law, peaks, strict=True)):
            colour, _ = kinds[Labels.of(curve.case).configuration]
            inset.plot(amplitude, largest, "o", mfc="none", mec=colour, ms=6, mew=0.7)
            inset.text(0.97, 0.95 - 0.11 * line, f"largest: {largest:.3f} at {amplitude:.3g} N", ha="right", va="top",
                       fontsize=6, color=colour, transform=inset.transAxes)  # fmt: skip
    for row in grid:
        label_outer(row[None], "Amplitude of the drive (N)", "Inter-band transfer (1)")
    return figure


def _draw(axes: Axes, shown: Sequence[Curve], kinds: dict[str, tuple[str, str]], size: float = 2.2) -> None:
    """The curves, each with its floor dashed; ``kinds`` has colour and mark by configuration."""
    for curve in shown:
        kind = Labels.of(curve.case).configuration
        colour, mark = kinds[kind]
        axes.plot(curve.data[AMPLITUDE], curve.data["ibtet"], color=colour, marker=mark, ms=size, lw=0.7, label=kind)
        if np.isfinite(curve.data["floor"]):
            axes.axhline(float(curve.data["floor"]), color=colour, lw=0.6, ls=(0, (4, 3)), zorder=1)


def ibtet_backbone(sweeps: Sweeps) -> Iterator[style.Drawing]:
    """Every reading and configuration of ``backbone.h5``, laws in columns; one made of another sweep is passed over."""
    for ensemble in sweeps:
        path = Path(ensemble.attrs["folder"]) / "backbone.h5"
        if not path.exists():
            continue
        groups: dict[str, dict[str, Any]] = {}
        with open_netcdf(path, "backbone", ("case",)) as file:
            variables = ((name, variable.values) for name, variable in file.variables.items())
            if file.attrs["case"] != ensemble.attrs["case"]:
                continue
            for name, value in (*file.attrs.items(), *variables):
                group, _, rest = str(name).partition("/")
                if rest:
                    groups.setdefault(group, {})[rest] = value
        aligned = [Curve(Case.from_toml(values["case"]), values) for values in groups.values()]
        ylabel = "Inter-band transfer, normalised slope (1)"
        for name, columns in grouped(aligned, lambda curve: Labels.of(curve.case).page_stem).items():
            yield name, partial(columns_of_laws, columns, 4.0, 3.0, ylabel, _superposition)


def _superposition(axes: Axes, aligned: Curve) -> str:
    """Points of the lattice, red where fitted; slope over the divisor dashed, with the floor grey; the law green."""
    curve = aligned.data
    energy, transfer, fitted = curve["energy"], curve["ibtet"], curve["fitted"].astype(bool)
    branch, slope, region = (curve[f"branch/{name}"] for name in ("energy", "slope", "region"))
    grazing, floor = curve["grazing_energy"], curve["floor"]
    scaled = np.where(region == 1, 0.0, np.abs(slope)) / curve["divisor"]
    left, right = 0.5 * min(energy.min(), 0.1 * grazing), 2 * energy.max()
    # Region I goes on to the left: below the first point of the branch its slope is zero as well.
    with_floor = np.append(left, branch), floor + np.append(0.0, scaled)
    axes.plot(*with_floor, color=style.GREY, lw=2.2, alpha=0.55, label="slope + floor")
    label = f"slope, $E^{{{curve['slope_exponent']:.2f}}}$ there"
    axes.plot(branch, np.where(scaled > 0, scaled, np.nan), color=style.BLACK, lw=0.8, ls=style.DASHED, label=label)
    axes.plot(energy, transfer, "-o", color=style.BLUE, ms=2.6, mfc="white", mew=0.6, lw=0.6, label="lattice")
    axes.plot(energy[fitted], transfer[fitted], "o", color=style.RED, ms=2.8, label="in region III")
    label = f"$E^{{{curve['exponent']:.2f}}}$, adj. $R^2$ {curve['r2_adjusted']:.3f}"
    law = curve["factor"] * energy[fitted] ** curve["exponent"]
    axes.plot(energy[fitted], law, color=style.GREEN, lw=1.4, zorder=4, label=label)
    shade_regions(axes, np.minimum(np.where(region == 1, grazing, branch), right), region, left, at_top=False)
    axes.set(xscale="log", yscale="log", xlabel="Normalised energy (J)", xlim=(left, right), ylim=(0.25 * floor, 4.0))
    axes.legend(loc="upper right", fontsize=6)
    return f"{Labels.of(aligned.case).law}; branch of the {curve['branch_reading']} reading"
