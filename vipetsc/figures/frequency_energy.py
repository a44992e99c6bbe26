"""Frequency-energy plots of branches, with grazing inset, slope and phase portraits (paper, Fig. 11)."""

import tomllib
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from string import ascii_lowercase

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullFormatter

from vipetsc.figures import style
from vipetsc.figures.panels import REGIONS, annotate_empty, empty_figure, note, shade_regions
from vipetsc.io.netcdf import open_netcdf

NEEDS = ("energy", "frequency", "slope", "multiplier_max", "region", "contacts", "kind", "resonance")
UNSTABLE = 1.0 + 1e-6  # Floquet multipliers above are not those of a stable orbit
MARKS = {
    "fold-energy": ("o", "energy fold"),
    "fold-frequency": ("s", "frequency fold"),
    "branch-point": ("D", "branch point"),
    "symmetry-breaking": ("^", "symmetry breaking"),
    "period-doubling": ("v", "period doubling"),
}
HOLLOW = {"mfc": "white", "mec": style.BLACK, "mew": 0.6, "zorder": 4}
MOST_MARKS = 12  # with more special points, tongues are labelled by their resonance instead, at their highest fold
FINE = 8  # points of the curve drawn for each step of a branch
CORNERS, INSET, MARGIN = ((0.55, 0.1), (0.55, 0.5), (0.1, 0.1)), (0.41, 0.36), 0.09  # of axes; room for its labels
LABELLED_TONGUES = 3, 5  # k of k:1; later ones crowd together


def backbone(paths: Sequence[Path]) -> Figure:
    """Frequency, slope and portraits of regions I-IV of the branches in ``paths``; one column a branch.

    Raises OSError or ValueError for a file that holds none.
    """
    branches = []
    for path in paths:
        with open_netcdf(path, "branch", NEEDS) as file:
            branch = file.load()
        kinds = np.array(branch["kind"].attrs["flag_meanings"].split())
        branches.append(branch.assign(kind=("point", kinds[branch["kind"].values])))
    if not all(branch.sizes["point"] for branch in branches):
        return empty_figure("no point of the branch was found")
    has_flows, has_orbits = (
        any(str(name).startswith(group) for branch in branches for name in branch.variables)
        for group in ("flows/", "orbits/number")
    )
    heights = (1.5, 1.0) + (1.0,) * has_flows
    tall = sum(heights) + 0.95 * has_orbits
    figure = style.new_figure(style.COLUMN if len(branches) == 1 else style.PAGE, 1.55 * tall)
    shares = (sum(heights), 0.95)[: 1 + has_orbits]
    columns = figure.subfigures(1, len(branches), squeeze=False)[0]
    for column, tag, branch in zip(columns, ascii_lowercase, branches, strict=False):
        upper, *lower = column.subfigures(1 + has_orbits, 1, squeeze=False, height_ratios=shares)[:, 0]
        panels = upper.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        energy = branch["energy"].values
        panels[0].set(xscale="log", xlim=(energy.min(), energy.max()))  # the inset looks for room in them
        for axes, draw in zip(panels, (frequency_energy, slope, flow_differences), strict=False):
            draw(axes, branch)
        # The reading is one of the paper's parameters only, not of a cell or system of one's own.
        table = tomllib.loads(branch.attrs.get("case", ""))
        custom = "cell" in table.get("lattice", {}) or table.get("nnm", {}).get("system") == "own"
        law = table.get("contacts", {}).get("law", "") if len(branches) > 1 else ""
        heading = branch.attrs["name"], law, "" if custom else table.get("lattice", {}).get("reading", "")
        panels[0].set_title(f"({tag}) {', '.join(filter(None, heading))}")
        panels[-1].set(xlabel="energy (J)")
        if energy.max() < 10 * energy.min():  # labels of less than a decade
            narrow = energy.max() < 3 * energy.min()
            panels[-1].xaxis.set_major_locator(MaxNLocator(4) if narrow else LogLocator(subs=(1, 2, 5)))
            panels[-1].xaxis.set_major_formatter(FormatStrFormatter("%.4g"))
            panels[-1].xaxis.set_minor_formatter(NullFormatter())
        for page in lower:
            portraits(page, branch)
    return figure


def frequency_energy(axes: Axes, branch: xr.Dataset) -> None:
    """Frequency over energy; unstable parts coloured, special points marked, grazing in the inset."""
    energy, frequency, kind = (branch[name].values for name in ("energy", "frequency", "kind"))
    few = np.isin(kind, list(MARKS)).sum() <= MOST_MARKS
    _shade(axes, branch)
    line(axes, branch)
    for name, (mark, label) in MARKS.items() if few else ():
        at = kind == name
        if at.any():
            axes.plot(energy[at], frequency[at], mark, ms=3, label=label, **HOLLOW)
    if not few:
        axes.margins(y=0.08)
        for number in LABELLED_TONGUES:
            k = branch["resonance"].values
            first = np.nonzero(k > number)[0][:1]  # folds behind it that have this k are on the way between tongues
            tongue = branch.isel(point=(k == number) & (np.arange(len(k)) < np.append(first, len(k))[0]))
            if tongue.sizes["point"]:
                tip = tongue.isel(point=int(np.argmax(tongue["frequency"].values)))
                at = float(tip["energy"]), float(tip["frequency"])
                note(axes, f"{number}:1", at, (1, 3), fontsize=5.5, color=style.GREY, ha="center")
    axes.set(ylabel="frequency (Hz)")
    if frequency.max() > 3 * frequency.min():
        axes.set(yscale="log", ylim=(None, 1.8 * frequency.max()))  # room for the regions' numerals
    touched = np.nonzero(branch["contacts"].values > 0)[0]
    if few and touched.size and touched[0] > 0:
        axes.legend(loc="upper left", fontsize=5.5, bbox_to_anchor=(0, 0.93))
        _grazing_inset(axes, branch, touched[0])
    else:
        clear = np.ptp(frequency) > 0 and (few or not touched.size)
        axes.legend(loc="lower right" if clear else "best", fontsize=5.5)


def slope(axes: Axes, branch: xr.Dataset) -> None:
    """|df/dE| over energy at the regular points where contacts act, at all without contact.

    Where several states of the branch have one energy, all but that of the lowest frequency are pale.
    """
    _shade(axes, branch)
    touches = branch["contacts"].values > 0
    some = (touches | (not touches.any())) & (branch["kind"].values == "regular")
    energy, steepness, low = (
        values[some] for values in (branch["energy"].values, np.abs(branch["slope"].values), lowest(branch))
    )
    if not low.all():
        axes.loglog(energy, steepness, lw=0.4, color=style.SKY, label="other states at their energies")
    label = None if low.all() else "lowest frequency at its energy"
    axes.loglog(energy, np.where(low, steepness, np.nan), lw=1.1, color=style.BLUE, label=label)
    if label:
        axes.legend(loc="lower left", fontsize=5.5)
    axes.set_ylabel(r"|d$f$/d$E$| (Hz/J)")


def flow_differences(axes: Axes, branch: xr.Dataset) -> None:
    """How far other flows are from the branch at the same amplitude: frequency (full) and energy (open marks)."""
    names = filter(lambda name: name.startswith("flows/"), map(str, branch.variables))
    flows = dict.fromkeys(name.split("/")[1] for name in names)
    if not flows:
        annotate_empty(axes, "no other flow was compared")
        return
    for name, colour in zip(flows, (style.VERMILION, style.GREEN, style.PURPLE), strict=False):
        for key, face in (("frequency", colour), ("energy", "white")):
            difference = np.maximum(np.abs(branch[f"flows/{name}/{key}_difference"].values), 1e-17)
            axes.loglog(branch[f"flows/{name}/energy"], difference, "o", ms=2.2, mec=colour, mfc=face, mew=0.5,
                        label=f"{name}: {key}")  # fmt: skip
    axes.set(ylabel="relative difference", ylim=(None, 10.0))  # room for the legend
    axes.legend(fontsize=5.5, ncols=2, loc="upper right")


def portraits(page: SubFigure, branch: xr.Dataset) -> None:
    """Phase portraits of the stored orbits of regions I-IV: the first two masses."""
    if "orbits/number" not in branch:
        annotate_empty(page.subplots(), "no orbits stored")
        return
    orbits = branch.isel(orbit=slice(4))
    regular = branch.isel(point=branch["kind"].values == "regular")
    grid = page.subplots(1, orbits.sizes["orbit"], sharey=True, squeeze=False)[0]
    for k, axes in enumerate(grid):
        energy, u, v = (orbits[f"orbits/{name}"].values[k] for name in ("energy", "displacement", "velocity"))
        closed = np.append(np.arange(len(u)), 0)
        for dof, (colour, dashes) in zip(range(u.shape[1]), ((style.BLUE, "-"), (style.VERMILION, "--")), strict=False):
            x, y = u[closed, dof] / np.abs(u).max(), v[closed, dof] / np.abs(v).max()
            axes.plot(x, y, color=colour, lw=0.8, ls=dashes)
        nearest = int(np.abs(np.log(regular["energy"] / energy)).argmin())
        region = REGIONS[int(regular["region"][nearest])]
        axes.set_title(f"{region}\n{energy:.2g} J", loc="center", fontsize=7)
        axes.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[-1, 1], yticks=[-1, 1], box_aspect=1)
    grid[0].set_ylabel(r"$\dot u$/max")
    page.supxlabel(r"$u$/max (solid: mass 1, dashed: mass 2)", fontsize=7)


def smooth(branch: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Energies and frequencies, ``FINE`` for each step: cubic Hermite curves through points and tangents.

    Both are logarithms there, over their range; the chord's length is the parameter. Where a contact grazes a curve
    ends and the next begins: the branch may have a corner.
    """
    energy, frequency = branch["energy"].values, branch["frequency"].values
    points = np.log(np.column_stack([energy, frequency]))
    if len(points) < 3 or "tangent_period" not in branch:
        return energy, frequency
    rate = -branch["tangent_period"].values * frequency**2  # df/ds; the slope is df/dE
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.column_stack([rate / branch["slope"].values / energy, rate / frequency])
    size = np.ptp(points, axis=0)
    points, along = points / np.where(size > 0, size, 1), along / np.where(size > 0, size, 1)
    chords = np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(chords, axis=1), 1e-300)[:, None]
    along[~np.isfinite(along).all(axis=1) | ~along.any(axis=1)] = np.nan
    along /= np.linalg.norm(along, axis=1)[:, None]
    along *= np.sign(np.nansum(along[:-1] * chords / length)) or 1.0
    begin, end = along[:-1].copy(), along[1:].copy()
    begin[branch["kind"].values[:-1] == "grazing"] = np.nan
    end[branch["kind"].values[1:] == "grazing"] = np.nan
    unit = chords / length
    begin, end = (np.where(np.isnan(a), np.where(np.isnan(b), unit, 2 * unit - b), a)
                  for a, b in ((begin, end), (end, begin)))  # fmt: skip
    t = (np.arange(FINE) / FINE)[:, None, None]
    cubic = points[:-1] + t**2 * (3 - 2 * t) * chords + length * (t * (1 - t) ** 2 * begin - t**2 * (1 - t) * end)
    fine = np.vstack([cubic.swapaxes(0, 1).reshape(-1, 2), points[-1:]])
    fine_energy, fine_frequency = np.exp(fine * np.where(size > 0, size, 1)).T
    return fine_energy, fine_frequency


def lowest(branch: xr.Dataset) -> np.ndarray:
    """Whether no other state of the branch has the energy of a point and a lower frequency."""
    energy, frequency = branch["energy"].values, branch["frequency"].values
    order = np.argsort(energy)
    least, ranks = frequency[order].copy(), np.searchsorted(energy[order], energy)
    for i, (a, b) in enumerate(pairwise(ranks)):
        between = slice(min(a, b) + 1, max(a, b))
        ends = np.sort([i, i + 1])[np.argsort(energy[i : i + 2])]
        others = np.interp(energy[order[between]], energy[ends], frequency[ends])
        least[between] = np.minimum(least[between], others)
    return frequency <= least[np.argsort(order)] * (1 + 1e-9)


def line(axes: Axes, branch: xr.Dataset, width: float = 1.1) -> None:
    """The branch, blue where stable, vermilion where not, grey where that is not known."""
    (energy, frequency), multiplier = smooth(branch), branch["multiplier_max"].values
    label = "stable" if np.any(multiplier <= UNSTABLE) else None
    axes.plot(energy, frequency, color=style.BLUE, lw=width, zorder=2, label=label)
    untold = np.isnan(multiplier)
    for at, colour, label in (multiplier > UNSTABLE, style.VERMILION, "unstable"), (untold, style.GREY, "not known"):
        if len(energy) > len(at):
            at = np.append(np.repeat(at[:-1] & at[1:], FINE), at[-1])
        if at.any():
            axes.plot(energy, np.where(at, frequency, np.nan), color=colour, lw=1.3 * width, zorder=3, label=label)


def _grazing_inset(axes: Axes, branch: xr.Dataset, first: int) -> None:
    """The neighbourhood of grazing: up to where the frequency has grown by a tenth, or the folds are passed."""
    energy, frequency = branch["energy"].values, branch["frequency"].values
    folds = np.nonzero(branch["kind"].values == "fold-energy")[0]
    last = int(folds[-1]) if folds.size else first
    last += int(np.searchsorted(frequency[last:], frequency[last] * 1.1))
    last = min(max(last, first + 3), len(energy) - 1)
    near = branch.isel(point=slice(max(first - 1, 0), last + 1))
    curve = axes.transAxes.inverted().transform(axes.transData.transform(np.column_stack(smooth(branch))))
    covered = [
        np.sum(np.all((curve > np.subtract(at, MARGIN)) & (curve < np.add(at, INSET)), axis=1)) for at in CORNERS
    ]
    inset = axes.inset_axes([*CORNERS[int(np.argmin(covered))], *INSET])
    line(inset, near, 0.9)
    at = near["kind"].values == "fold-energy"
    inset.plot(near["energy"][at], near["frequency"][at], "o", ms=2.5, **HOLLOW)
    inset.margins(0.1)
    inset.tick_params(labelsize=5, pad=1.5)
    inset.locator_params(axis="both", nbins=3)
    inset.set_title("grazing", fontsize=6, pad=1.5)


def _shade(axes: Axes, branch: xr.Dataset) -> None:
    """Regions as bands of energy; left out where there is no region III (internal resonances)."""
    energy, region = branch["energy"].values, branch["region"].values
    if np.any(region == 3):
        shade_regions(axes, energy, region, energy[region == region.min()].min(), at_top=True)
