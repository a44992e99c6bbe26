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
LABELLED_TONGUES = 3, 5  # k of k:1; later ones crowd together

# Heights of the panels of a column, in units of 1.55 inches.
FREQUENCY_HEIGHT = 1.5
OTHER_HEIGHT = 1.0
PORTRAITS_HEIGHT = 0.95
INCHES = 1.55

# Of the inset on grazing, in fractions of the axes: lower left corners that it may take, its size, room for its labels.
CORNERS = ((0.55, 0.1), (0.55, 0.5), (0.1, 0.1))
INSET = (0.41, 0.36)
MARGIN = 0.09


def backbone(paths: Sequence[Path]) -> Figure:
    """Draw frequency, slope and portraits of regions I-IV of the branches in ``paths``; one column a branch.

    Raises OSError or ValueError for a file that holds none.
    """
    branches = [_read(path) for path in paths]
    if not all(branch.sizes["point"] for branch in branches):
        return empty_figure("no point of the branch was found")

    # All columns have the panels that one of them needs, so that their axes are side by side.
    has_flows = any(_holds(branch, "flows/") for branch in branches)
    has_orbits = any(_holds(branch, "orbits/number") for branch in branches)
    draw_panels = [frequency_energy, slope]
    heights = [FREQUENCY_HEIGHT, OTHER_HEIGHT]
    if has_flows:
        draw_panels.append(flow_differences)
        heights.append(OTHER_HEIGHT)
    page_heights = [sum(heights)]
    if has_orbits:
        page_heights.append(PORTRAITS_HEIGHT)

    width = style.COLUMN if len(branches) == 1 else style.PAGE
    figure = style.new_figure(width, INCHES * sum(page_heights))
    columns = figure.subfigures(1, len(branches), squeeze=False)[0]
    for column, tag, branch in zip(columns, ascii_lowercase, branches, strict=False):
        upper, *lower = column.subfigures(len(page_heights), 1, squeeze=False, height_ratios=page_heights)[:, 0]
        panels = upper.subplots(len(heights), 1, sharex=True, height_ratios=heights)

        # The limits come first: the inset looks for room in them.
        energy = branch["energy"].values
        panels[0].set(xscale="log", xlim=(energy.min(), energy.max()))
        for axes, draw_panel in zip(panels, draw_panels, strict=True):
            draw_panel(axes, branch)

        heading = _heading(branch, with_law=len(branches) > 1)
        panels[0].set_title(f"({tag}) {heading}")
        panels[-1].set(xlabel="energy (J)")
        _label_narrow_energies(panels[-1], energy)
        for page in lower:
            portraits(page, branch)
    return figure


def _read(path: Path) -> xr.Dataset:
    """Return the branch in ``path`` with the kinds of its points in words."""
    with open_netcdf(path, "branch", NEEDS) as file:
        branch = file.load()
    kinds = np.array(branch["kind"].attrs["flag_meanings"].split())
    return branch.assign(kind=("point", kinds[branch["kind"].values]))


def _holds(branch: xr.Dataset, beginning: str) -> bool:
    """Return whether the name of any variable of ``branch`` begins so."""
    return any(str(name).startswith(beginning) for name in branch.variables)


def _heading(branch: xr.Dataset, with_law: bool) -> str:
    """Return the branch's name, its law if it is to be named, and its reading."""
    table = tomllib.loads(branch.attrs.get("case", ""))
    lattice = table.get("lattice", {})
    parts = [branch.attrs["name"]]
    if with_law:
        parts.append(table.get("contacts", {}).get("law", ""))

    # The reading is one of the paper's parameters only, not of a cell or system of one's own.
    is_custom = "cell" in lattice or table.get("nnm", {}).get("system") == "own"
    if not is_custom:
        parts.append(lattice.get("reading", ""))
    return ", ".join(part for part in parts if part)


def _label_narrow_energies(axes: Axes, energy: np.ndarray) -> None:
    """Label an axis of less than a decade, on which matplotlib's logarithmic labels are none or crowd together."""
    if energy.max() >= 10 * energy.min():
        return
    very_narrow = energy.max() < 3 * energy.min()
    axes.xaxis.set_major_locator(MaxNLocator(4) if very_narrow else LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%.4g"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def frequency_energy(axes: Axes, branch: xr.Dataset) -> None:
    """Draw frequency over energy; unstable parts coloured, special points marked, grazing in the inset."""
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    kind = branch["kind"].values
    few_marks = np.isin(kind, list(MARKS)).sum() <= MOST_MARKS
    _shade(axes, branch)
    draw_branch(axes, branch)

    if few_marks:
        for name, (mark, label) in MARKS.items():
            at = kind == name
            if at.any():
                axes.plot(energy[at], frequency[at], mark, ms=3, label=label, **HOLLOW)
    else:
        axes.margins(y=0.08)
        for order in LABELLED_TONGUES:
            _label_tongue(axes, branch, order)

    axes.set(ylabel="frequency (Hz)")
    if frequency.max() > 3 * frequency.min():
        axes.set(yscale="log", ylim=(None, 1.8 * frequency.max()))  # room for the regions' numerals

    touched = np.nonzero(branch["contacts"].values > 0)[0]
    if few_marks and touched.size and touched[0] > 0:
        axes.legend(loc="upper left", fontsize=5.5, bbox_to_anchor=(0, 0.93))
        _grazing_inset(axes, branch, touched[0])
    else:
        lower_right_is_free = np.ptp(frequency) > 0 and (few_marks or not touched.size)
        axes.legend(loc="lower right" if lower_right_is_free else "best", fontsize=5.5)


def _label_tongue(axes: Axes, branch: xr.Dataset, order: int) -> None:
    """Write "order:1" above the highest point of that tongue, if the branch has it."""
    k = branch["resonance"].values

    # Folds behind the first of a higher resonance that have this k are between tongues.
    higher = np.nonzero(k > order)[0]
    end = higher[0] if higher.size else len(k)
    tongue = branch.isel(point=(k == order) & (np.arange(len(k)) < end))
    if tongue.sizes["point"]:
        tip = tongue.isel(point=int(np.argmax(tongue["frequency"].values)))
        at = float(tip["energy"]), float(tip["frequency"])
        note(axes, f"{order}:1", at, (1, 3), fontsize=5.5, color=style.GREY, ha="center")


def slope(axes: Axes, branch: xr.Dataset) -> None:
    """Draw |df/dE| over energy at the regular points where contacts act, at all without contact.

    Where several states of the branch have one energy, all but that of the lowest frequency are pale.
    """
    _shade(axes, branch)
    shown = branch["kind"].values == "regular"
    touches = branch["contacts"].values > 0
    if touches.any():
        shown &= touches
    energy = branch["energy"].values[shown]
    steepness = np.abs(branch["slope"].values)[shown]
    is_lowest = lowest(branch)[shown]

    label = None
    if not is_lowest.all():
        axes.loglog(energy, steepness, lw=0.4, color=style.SKY, label="other states at their energies")
        label = "lowest frequency at its energy"
    axes.loglog(energy, np.where(is_lowest, steepness, np.nan), lw=1.1, color=style.BLUE, label=label)
    if label:
        axes.legend(loc="lower left", fontsize=5.5)
    axes.set_ylabel(r"|d$f$/d$E$| (Hz/J)")


def flow_differences(axes: Axes, branch: xr.Dataset) -> None:
    """Draw how far other flows are from the branch at the same amplitude: frequency (full), energy (open marks)."""
    paths = [str(name) for name in branch.variables if str(name).startswith("flows/")]
    flows = list(dict.fromkeys(path.split("/")[1] for path in paths))
    if not flows:
        annotate_empty(axes, "no other flow was compared")
        return

    for name, colour in zip(flows, (style.VERMILION, style.GREEN, style.PURPLE), strict=False):
        energy = branch[f"flows/{name}/energy"]
        for key, face in (("frequency", colour), ("energy", "white")):
            difference = np.maximum(np.abs(branch[f"flows/{name}/{key}_difference"].values), 1e-17)
            look = {"ms": 2.2, "mec": colour, "mfc": face, "mew": 0.5}
            axes.loglog(energy, difference, "o", label=f"{name}: {key}", **look)
    axes.set(ylabel="relative difference", ylim=(None, 10.0))  # room for the legend
    axes.legend(fontsize=5.5, ncols=2, loc="upper right")


def portraits(page: SubFigure, branch: xr.Dataset) -> None:
    """Draw phase portraits of the stored orbits of regions I-IV: the first two masses."""
    if "orbits/number" not in branch:
        annotate_empty(page.subplots(), "no orbits stored")
        return

    orbits = branch.isel(orbit=slice(4))
    regular = branch.isel(point=branch["kind"].values == "regular")
    grid = page.subplots(1, orbits.sizes["orbit"], sharey=True, squeeze=False)[0]
    for k, axes in enumerate(grid):
        energy = orbits["orbits/energy"].values[k]
        _draw_orbit(axes, orbits["orbits/displacement"].values[k], orbits["orbits/velocity"].values[k])

        nearest = int(np.abs(np.log(regular["energy"] / energy)).argmin())
        region = REGIONS[int(regular["region"][nearest])]
        axes.set_title(f"{region}\n{energy:.2g} J", loc="center", fontsize=7)
        axes.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[-1, 1], yticks=[-1, 1], box_aspect=1)
    grid[0].set_ylabel(r"$\dot u$/max")
    page.supxlabel(r"$u$/max (solid: mass 1, dashed: mass 2)", fontsize=7)


def _draw_orbit(axes: Axes, u: np.ndarray, v: np.ndarray) -> None:
    """Draw the first two masses of an orbit, ``u`` and ``v`` (phase, mass), over the largest of all its masses."""
    x = np.vstack([u, u[:1]]) / np.abs(u).max()  # closed
    y = np.vstack([v, v[:1]]) / np.abs(v).max()
    looks = ((style.BLUE, "-"), (style.VERMILION, "--"))
    for mass, (colour, dashes) in zip(range(u.shape[1]), looks, strict=False):
        axes.plot(x[:, mass], y[:, mass], color=colour, lw=0.8, ls=dashes)


def smooth(branch: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return energies and frequencies, ``FINE`` for each step: cubic Hermite curves through points and tangents.

    Both are logarithms there, over their range; the chord's length is the parameter. Where a contact grazes a curve
    ends and the next begins: the branch may have a corner.
    """
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    if len(energy) < 3 or "tangent_period" not in branch:
        return energy, frequency

    points = np.log(np.column_stack([energy, frequency]))
    extent = np.ptp(points, axis=0)
    scale = np.where(extent > 0, extent, 1)
    points /= scale
    chords = np.diff(points, axis=0)
    length = np.maximum(np.linalg.norm(chords, axis=1), 1e-300)[:, None]
    unit_chord = chords / length
    begin, end = _end_tangents(branch, scale, unit_chord)

    # The basis of a cubic Hermite curve; (step, FINE) points become one list, which ends with the last point itself.
    t = (np.arange(FINE) / FINE)[:, None, None]
    cubic = points[:-1] + t**2 * (3 - 2 * t) * chords + length * (t * (1 - t) ** 2 * begin - t**2 * (1 - t) * end)
    fine = np.vstack([cubic.swapaxes(0, 1).reshape(-1, 2), points[-1:]])
    fine_energy, fine_frequency = np.exp(fine * scale).T
    return fine_energy, fine_frequency


def _end_tangents(branch: xr.Dataset, scale: np.ndarray, unit_chord: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit tangents (step, 2) at the begin and the end of every step, in logarithms over ``scale``."""
    energy = branch["energy"].values
    frequency = branch["frequency"].values

    # The file has dT/ds and df/dE, so df/ds = -f^2 dT/ds, and dE/ds = (df/ds) / (df/dE).
    rate = -branch["tangent_period"].values * frequency**2
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.column_stack([rate / branch["slope"].values / energy, rate / frequency])
    tangents /= scale
    tangents[~np.isfinite(tangents).all(axis=1) | ~tangents.any(axis=1)] = np.nan
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]

    # Tangents of a branch point one way all along it; the points are listed that way or the opposite one.
    tangents *= np.sign(np.nansum(tangents[:-1] * unit_chord)) or 1.0

    # At a grazing point the tangent is that of one side: neither step takes it.
    begin = tangents[:-1].copy()
    end = tangents[1:].copy()
    begin[branch["kind"].values[:-1] == "grazing"] = np.nan
    end[branch["kind"].values[1:] == "grazing"] = np.nan
    return _completed(begin, end, unit_chord), _completed(end, begin, unit_chord)


def _completed(tangent: np.ndarray, other: np.ndarray, unit_chord: np.ndarray) -> np.ndarray:
    """Return the ``tangent`` at one end of every step; where it is NaN, such that the step is a parabola or straight.

    ``other`` is that at the other end: a parabola's two tangents have the chord as their mean.
    """
    by_other = np.where(np.isnan(other), unit_chord, 2 * unit_chord - other)
    return np.where(np.isnan(tangent), by_other, tangent)


def lowest(branch: xr.Dataset) -> np.ndarray:
    """Return whether (point) no other state of the branch has the energy of a point and a lower frequency."""
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    order = np.argsort(energy)
    ranks = np.searchsorted(energy[order], energy)

    # Each step of the branch is a line over energy, below which the points between its ends may lie.
    least = frequency[order].copy()
    for i, (rank, next_rank) in enumerate(pairwise(ranks)):
        between = slice(min(rank, next_rank) + 1, max(rank, next_rank))
        ends = np.sort([i, i + 1])[np.argsort(energy[i : i + 2])]
        on_line = np.interp(energy[order[between]], energy[ends], frequency[ends])
        least[between] = np.minimum(least[between], on_line)
    return frequency <= least[np.argsort(order)] * (1 + 1e-9)


def draw_branch(axes: Axes, branch: xr.Dataset, width: float = 1.1) -> None:
    """Draw the branch, blue where stable, vermilion where not, grey where that is not known."""
    energy, frequency = smooth(branch)
    multiplier = branch["multiplier_max"].values
    stable_label = "stable" if np.any(multiplier <= UNSTABLE) else None
    axes.plot(energy, frequency, color=style.BLUE, lw=width, zorder=2, label=stable_label)

    parts = ((multiplier > UNSTABLE, style.VERMILION, "unstable"), (np.isnan(multiplier), style.GREY, "not known"))
    for at, colour, label in parts:
        if len(energy) > len(at):
            # The points of a step belong to the part if both of its ends do.
            at = np.append(np.repeat(at[:-1] & at[1:], FINE), at[-1])
        if at.any():
            axes.plot(energy, np.where(at, frequency, np.nan), color=colour, lw=1.3 * width, zorder=3, label=label)


def _grazing_inset(axes: Axes, branch: xr.Dataset, first: int) -> None:
    """Draw the neighbourhood of grazing, point ``first``, in the corner where it covers least of the branch.

    It reaches to where the frequency has grown by a tenth, or the folds are passed.
    """
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    folds = np.nonzero(branch["kind"].values == "fold-energy")[0]
    last = int(folds[-1]) if folds.size else first
    last += int(np.searchsorted(frequency[last:], frequency[last] * 1.1))
    last = min(max(last, first + 3), len(energy) - 1)
    near = branch.isel(point=slice(max(first - 1, 0), last + 1))

    in_pixels = axes.transData.transform(np.column_stack(smooth(branch)))
    curve = axes.transAxes.inverted().transform(in_pixels)
    covered = []
    for corner in CORNERS:
        inside = (curve > np.subtract(corner, MARGIN)) & (curve < np.add(corner, INSET))
        covered.append(np.sum(np.all(inside, axis=1)))
    inset = axes.inset_axes([*CORNERS[int(np.argmin(covered))], *INSET])

    draw_branch(inset, near, width=0.9)
    at_fold = near["kind"].values == "fold-energy"
    inset.plot(near["energy"][at_fold], near["frequency"][at_fold], "o", ms=2.5, **HOLLOW)
    inset.margins(0.1)
    inset.tick_params(labelsize=5, pad=1.5)
    inset.locator_params(axis="both", nbins=3)
    inset.set_title("grazing", fontsize=6, pad=1.5)


def _shade(axes: Axes, branch: xr.Dataset) -> None:
    """Shade regions as bands of energy; none where there is no region III (internal resonances)."""
    energy = branch["energy"].values
    region = branch["region"].values
    if np.any(region == 3):
        left = energy[region == region.min()].min()
        shade_regions(axes, energy, region, left, at_top=True)
