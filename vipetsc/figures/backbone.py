"""The frequency-energy plot of a branch, with its grazing inset, slope and phase portraits, from its file."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style

UNSTABLE = 1.0 + 1e-6
_REGIONS = ("", "I", "II", "III", "IV")
_SHADES = ("#FFFFFF", "#EEEEEE", "#FFFFFF", "#EEEEEE")
_MARKS = {
    "fold-energy": ("o", "energy fold"),
    "fold-frequency": ("s", "frequency fold"),
    "branch-point": ("D", "branch point"),
    "symmetry-breaking": ("^", "symmetry breaking"),
    "period-doubling": ("v", "period doubling"),
}


@dataclass(frozen=True, eq=False)
class BranchFile:
    """What the figure needs of a ``branch-<name>.h5``: arrays over points, orbits (may be empty).

    ``reading`` is that of the paper's parameters, empty for a cell or a system of one's own.
    """

    name: str
    law: str
    reading: str
    data: dict[str, np.ndarray]
    kinds: list[str]
    orbits: dict[str, np.ndarray]
    flows: dict[str, dict[str, np.ndarray]]

    @classmethod
    def read(cls, path: Path) -> BranchFile:
        """Raises OSError or KeyError if the file holds no branch."""
        with h5py.File(path) as file:
            names = ("energy", "frequency", "slope", "multiplier_max", "region", "contacts", "kind", "resonance")
            data = {name: file[name][...] for name in names}
            kinds = str(file["kind"].attrs["flag_meanings"]).split()
            orbits = {n: v[...] for n, v in file["orbits"].items()} if "orbits" in file else {}
            flows = {f: {n: v[...] for n, v in g.items()} for f, g in file.get("flows", {}).items()}
            table = tomllib.loads(file.attrs.get("case", ""))
            law, lattice = table.get("contacts", {}).get("law", ""), table.get("lattice", {})
            own = "cell" in lattice or table.get("nnm", {}).get("system") == "own"
            reading = "" if own else lattice.get("reading", "")
            return cls(str(file.attrs["name"]), law, reading, data, [kinds[k] for k in data["kind"]], orbits, flows)


def page(paths: Sequence[Path]) -> Figure:
    """The branches in ``paths``, a column a branch; raises OSError or KeyError for a file that holds none."""
    branches = [BranchFile.read(path) for path in paths]
    if not all(len(b.kinds) for b in branches):
        return style.without_data("no point of the branch was found")
    return backbone(branches)


def backbone(branches: Sequence[BranchFile]) -> Figure:
    """The paper's Fig. FEP: frequency, slope and portraits of regions I-IV; one column a branch."""
    count = len(branches)
    width = style.COLUMN if count == 1 else style.PAGE
    with_orbits = any(b.orbits for b in branches)
    with_flows = any(b.flows for b in branches)
    heights = (1.5, 1.0) + (1.0,) * with_flows + (0.95,) * with_orbits
    figure = style.new_figure(width, 1.55 * sum(heights))
    rows = figure.subfigures(len(heights), count, squeeze=False, height_ratios=heights)
    for column, branch in enumerate(branches):
        label = chr(ord("a") + column)
        top = rows[0, column].subplots()
        frequency_energy(top, branch)
        words = [branch.name, branch.law if count > 1 else "", branch.reading]
        style.letter(top, f"({label}) {', '.join(filter(None, words))}")
        slope(rows[1, column].subplots(), branch)
        if with_flows:
            flow_differences(rows[2, column].subplots(), branch)
        if with_orbits:
            portraits(rows[-1, column], branch)
    return figure


def frequency_energy(axes: Axes, branch: BranchFile) -> None:
    """Frequency over energy; unstable parts coloured, special points marked, grazing in the inset."""
    _shade(axes, branch)
    _line(axes, branch)
    axes.set(xscale="log", yscale=_scale(branch.data["frequency"]), xlabel="energy (J)", ylabel="frequency (Hz)")
    energy, frequency = branch.data["energy"], branch.data["frequency"]
    few = sum(k in _MARKS for k in branch.kinds) <= 12
    for kind, (mark, text) in _MARKS.items():
        at = [i for i, k in enumerate(branch.kinds) if k == kind]
        if at and few:
            axes.plot(
                energy[at], frequency[at], mark, ms=3, mfc="white", mec=style.BLACK, mew=0.6, label=text, zorder=4
            )
    if not few:
        _label_tongues(axes, branch)
    axes.plot([], [], color=style.BLUE, label="stable")
    if np.any(branch.data["multiplier_max"] > UNSTABLE):
        axes.plot([], [], color=style.VERMILION, label="unstable")
    if _scale(frequency) == "log":
        axes.set_ylim(top=1.8 * frequency.max())  # room for the regions' numerals
    touched = np.nonzero(branch.data["contacts"] > 0)[0]
    monotone = np.ptp(frequency) > 0 and (few or not touched.size)
    inside = few and touched.size > 0
    axes.legend(loc="upper left" if inside else "lower right" if monotone else "best", fontsize=5.5,
                bbox_to_anchor=(0, 0.93) if inside else None)  # fmt: skip
    if touched.size and few:
        _grazing_inset(axes, branch, touched[0])


def _label_tongues(axes: Axes, branch: BranchFile, largest: int = 5) -> None:
    """Write k:1 at the fold of highest frequency of every tongue up to ``largest``:1; later ones crowd together."""
    energy, frequency, k = (branch.data[n] for n in ("energy", "frequency", "resonance"))
    axes.margins(y=0.08)
    for number in range(3, largest + 1, 2):
        at = np.nonzero(k == number)[0]
        if at.size:
            tip = at[int(np.argmax(frequency[at]))]
            axes.annotate(f"{number}:1", (energy[tip], frequency[tip]), (1, 3), textcoords="offset points",
                          fontsize=5.5, color=style.GREY, ha="center")  # fmt: skip


def slope(axes: Axes, branch: BranchFile) -> None:
    """|df/dE| over energy where contacts act, with its power laws' local exponents left to the text."""
    _shade(axes, branch)
    energy, steep = branch.data["energy"], np.abs(branch.data["slope"])
    moving = branch.data["contacts"] > 0 if np.any(branch.data["contacts"] > 0) else np.ones(len(energy), bool)
    moving &= np.array([k == "regular" for k in branch.kinds])
    axes.plot(energy[moving], steep[moving], color=style.BLUE, lw=0.9)
    axes.set(xscale="log", yscale="log", xlabel="energy (J)", ylabel=r"|d$f$/d$E$| (Hz/J)")
    axes.set_xlim(energy.min(), energy.max())


def flow_differences(axes: Axes, branch: BranchFile) -> None:
    """How far other flows are from the branch at the same amplitude: frequency (full) and energy (open marks)."""
    if not branch.flows:
        style.say(axes, "no other flow was compared")
        return
    for (name, found), colour in zip(branch.flows.items(), (style.VERMILION, style.GREEN, style.PURPLE), strict=False):
        for key, face in (("frequency", colour), ("energy", "white")):
            size = np.maximum(np.abs(found[f"{key}_difference"]), 1e-17)
            axes.plot(found["energy"], size, "o", ms=2.2, mec=colour, mfc=face, mew=0.5, label=f"{name}: {key}")
    axes.set(xscale="log", yscale="log", xlabel="energy (J)", ylabel="relative difference")
    axes.set_xlim(branch.data["energy"].min(), branch.data["energy"].max())
    axes.set_ylim(top=10.0)  # room for the legend
    axes.legend(fontsize=5.5, ncols=2, loc="upper right")


def portraits(place: object, branch: BranchFile) -> None:
    """Phase portraits of the stored orbits of regions I-IV: the resonator (or last mass) and the host."""
    if not branch.orbits:
        style.say(place.subplots(), "no orbits stored")
        return
    number = branch.orbits["number"]
    shown = min(len(number), 4)
    axes = place.subplots(1, shown, squeeze=False)[0]
    regular = [i for i, k in enumerate(branch.kinds) if k == "regular"]
    for k in range(shown):
        u, v = branch.orbits["displacement"][k], branch.orbits["velocity"][k]
        for dof, colour in zip(range(min(u.shape[1], 2)), (style.BLUE, style.VERMILION), strict=False):
            closed = np.append(np.arange(len(u)), 0)
            axes[k].plot(
                u[closed, dof] / np.abs(u).max(),
                v[closed, dof] / np.abs(v).max(),
                color=colour,
                lw=0.8,
                ls="--" if dof else "-",
            )
        region = branch.data["region"][min(regular, key=lambda i: abs(i - _place(branch, branch.orbits["energy"][k])))]
        axes[k].set_title(f"{_REGIONS[region]}\n{branch.orbits['energy'][k]:.2g} J", loc="center", fontsize=7)
        axes[k].set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[-1, 1], yticks=[-1, 1], box_aspect=1)
        if k:
            axes[k].set_yticklabels([])
    axes[0].set_ylabel(r"$\dot u$/max")
    place.supxlabel(r"$u$/max (solid: mass 1, dashed: mass 2)", fontsize=7)


def _place(branch: BranchFile, energy: float) -> int:
    return int(np.abs(np.log(branch.data["energy"] / energy)).argmin())


def _line(axes: Axes, branch: BranchFile, width: float = 1.1) -> None:
    """The branch, blue where stable and vermilion where not; neighbours share their end points."""
    energy, frequency = branch.data["energy"], branch.data["frequency"]
    loose = branch.data["multiplier_max"] > UNSTABLE
    axes.plot(energy, frequency, color=style.BLUE, lw=width, zorder=2)
    either = loose.copy()
    either[1:] |= loose[:-1] & loose[1:]
    axes.plot(energy, np.where(either, frequency, np.nan), color=style.VERMILION, lw=width * 1.3, zorder=3)


def _grazing_inset(axes: Axes, branch: BranchFile, first: int) -> None:
    """The neighbourhood of grazing: up to where the frequency has grown by a fifth, or the folds are passed."""
    energy, frequency = branch.data["energy"], branch.data["frequency"]
    folds = [i for i, k in enumerate(branch.kinds) if k == "fold-energy"]
    last = max(folds, default=first)
    last += int(np.searchsorted(frequency[last:], frequency[last] * 1.1))
    last = min(max(last, first + 3), len(energy) - 1)
    window = slice(max(first - 1, 0), last + 1)
    inset = axes.inset_axes([0.55, 0.1, 0.41, 0.36])
    _line(inset, branch, 0.9)
    at = [i for i in folds if window.start <= i <= last]
    inset.plot(energy[at], frequency[at], "o", ms=2.5, mfc="white", mec=style.BLACK, mew=0.6, zorder=4)
    low, high = energy[window].min(), energy[window].max()
    span = high - low
    inset.set(xlim=(low - 0.15 * span, high + 0.1 * span))
    rise = np.ptp(frequency[window])
    inset.set(ylim=(frequency[window].min() - 0.1 * rise, frequency[window].max()))
    inset.tick_params(labelsize=5, pad=1.5)
    inset.locator_params(axis="both", nbins=3)
    inset.set_title("grazing", fontsize=6, pad=1.5)


def _shade(axes: Axes, branch: BranchFile) -> None:
    """Regions as bands of energy, labelled at the top; left out where they overlap (internal resonances)."""
    energy, region = branch.data["energy"], branch.data["region"]
    spans = [
        (energy[region == k].min(), energy[region == k].max()) if np.any(region == k) else None for k in (1, 2, 3, 4)
    ]
    if spans[2] is None:
        return
    for k, span in enumerate(spans):
        if span is None:
            continue
        low = spans[k - 1][1] if k and spans[k - 1] else span[0]
        axes.axvspan(low, max(span[1], low), color=_SHADES[k], lw=0, zorder=0)
        if max(span[1], low) > low:
            middle = np.sqrt(low * max(span[1], low))
            axes.text(middle, 0.985, _REGIONS[k + 1], ha="center", va="top", fontsize=6.5, color=style.GREY,
                      transform=axes.get_xaxis_transform())  # fmt: skip
    axes.set_xlim(energy.min(), energy.max())


def _scale(values: np.ndarray) -> str:
    return "log" if values.max() > 3 * values.min() else "linear"
