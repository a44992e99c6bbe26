"""Frequency-energy plots of branches, with grazing inset, slope and phase portraits (Fig. 11 of the paper).

The paper is J. R. Tempelman, A. F. Vakakis, K. H. Matlack, Phys. Rev. E 108, 044214 (2023). Its parameters have two
*readings*, printed and calibrated (to its figures), which the case key ``lattice.reading`` names.

A *branch* is a curve of periodic orbits, its points in the order in which continuation found them: several may have one
energy. *Regular* points end the steps of the continuation. Special points lie between them: where the energy or the
frequency turns back (folds), where an orbit just touches a contact (grazing), and the other kinds of ``MARKS``.

On a k:1 internal *resonance* one mode moves k times while the other moves once. There a branch makes a *tongue*: it
leaves its trend and comes back, with an energy fold at the tip. The files have k at energy folds.

*Regions* of the energy (``modes.branches.regions``): I no contact, II grazing, III vibro-impact, IV the smooth limit,
where the clearance is negligible; 0 where there are only smooth springs.
"""

import tomllib
from collections.abc import Sequence
from pathlib import Path
from string import ascii_lowercase

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullFormatter

from vipetsc.figures import style
from vipetsc.figures.branch_curves import draw_branch, draw_losses, lowest, smooth
from vipetsc.figures.page import ROMAN
from vipetsc.figures.panels import REGIONS, annotate_empty, note, shade_regions
from vipetsc.io.branch_kinds import CHOSEN, DOWN, kind_names
from vipetsc.io.netcdf import open_netcdf

# What the panels read; ``draw_branch`` shows by ``multiplier_max`` which orbits are stable.
NEEDS = ("energy", "frequency", "slope", "multiplier_max", "region", "contacts", "kind", "resonance", "number")
MARKS = {
    "fold-energy": ("o", "energy fold"),
    "fold-frequency": ("s", "frequency fold"),
    "branch-point": ("D", "branch point"),
    "symmetry-breaking": ("^", "symmetry breaking"),
    "period-doubling": ("v", "period doubling"),
    CHOSEN: ("X", "chosen value"),
}
HOLLOW = {"mfc": "white", "mec": style.BLACK, "mew": 0.6, "zorder": 4}
# Special points that are marked. A branch through many tongues has hundreds, whose marks would hide the curve: there
# the tongues are labelled by their resonance instead, at their highest fold.
MOST_MARKS = 12
LABELLED_TONGUES = 3, 5  # k of k:1; later ones crowd together

MOST_ORBITS = 4  # whose portraits have room
SLOPE = r"|d$f$/d$E$| (Hz/J)"
ROUNDING = 1e-12  # of a frequency: its change from energy 0 on, by the slope, that a linear motion has

# Heights of the panels of a column, in units of 1.55 inches.
FREQUENCY_HEIGHT = 1.5
OTHER_HEIGHT = 1.0
PORTRAITS_HEIGHT = 0.95
INCHES = 1.55

# The inset on grazing, in fractions of the axes: its size, how far it may shrink, and room for its labels.
INSET = (0.41, 0.36)
SHRINKING = (1.0, 0.85, 0.7)
MARGINS = (0.13, 0.1), (0.03, 0.07)  # left and below, right and above
LEGEND = (0.45, 0.6)  # the upper left corner beyond which the legend is
# Positions along either axis that are tried for the inset, and points of the curve that it is kept off: neighbouring
# positions differ by 3 % of the axes, and points by less than that is wide.
PLACES = 17
CURVE_POINTS = 4000


def backbone(paths: Sequence[Path]) -> Figure:
    """Draw frequency, slope, damping and phase portraits of the branches in ``paths``.

    Each branch has a column. A panel is there if one of the branches has what it shows. Raises OSError or ValueError
    for a file that holds no branch.
    """
    branches = [read_branch(path, NEEDS) for path in paths]

    # All columns have the panels that one of them needs, so that their axes are side by side.
    has_orbits = any(_holds(branch, "orbits/number") for branch in branches)
    draw_panels = [frequency_energy, slope]
    heights = [FREQUENCY_HEIGHT, OTHER_HEIGHT]
    if any("damping_ratio" in branch for branch in branches):
        draw_panels.append(draw_losses)
        heights.append(OTHER_HEIGHT)
    page_heights = [sum(heights)]
    if has_orbits:
        page_heights.append(PORTRAITS_HEIGHT)

    is_alone = len(branches) == 1
    figure = style.new_figure(style.COLUMN if is_alone else style.PAGE, INCHES * sum(page_heights))
    columns = figure.subfigures(1, len(branches), squeeze=False)[0]
    for column, tag, branch in zip(columns, ascii_lowercase, branches, strict=False):
        upper, *lower = column.subfigures(len(page_heights), 1, squeeze=False, height_ratios=page_heights)[:, 0]
        panels = upper.subplots(len(heights), 1, sharex=True, height_ratios=heights)

        # The limits of the energy are set first, because the inset looks for room between them.
        energy = branch["energy"].values
        panels[0].set(xscale="log", xlim=(energy.min(), energy.max()))
        for axes, draw_panel in zip(panels, draw_panels, strict=True):
            draw_panel(axes, branch)

        panels[0].set_title(_heading(branch, with_law=len(branches) > 1))
        panels[-1].set(xlabel="energy (J)")
        _label_narrow_energies(panels[-1], energy)

        letters = list(ascii_lowercase) if is_alone else [f"{tag}.{number}" for number in ROMAN]
        for panel_tag, axes in zip(letters, panels, strict=False):
            axes.set_title(f"({panel_tag}) {axes.get_title('left')}".rstrip())
        for part in lower:
            portraits(part, branch, letters[len(panels)])
    return figure


def read_branch(path: Path, needs: Sequence[str]) -> xr.Dataset:
    """Return the branch in ``path``, joined to the one towards smaller energies if the mode has both.

    ``needs`` are the variables by which a branch of this kind is known. Raises OSError or ValueError without them.
    """
    branch = _load(path, needs)
    below = path.with_name(f"{path.stem}{DOWN}.h5")
    if not below.exists():
        return branch

    # Backwards, and without the start, which both have.
    down = _load(below, needs).isel(point=slice(None, 0, -1))
    down = down.assign(number=-down["number"])
    if "tangent_period" in down:
        down = down.assign(tangent_period=-down["tangent_period"])
    # Unknowns of branches with other numbers of harmonics are not joined: pictures do not need them.
    both = [
        name
        for name, values in branch.items()
        if "point" in values.dims and name in down and down[name].shape[1:] == values.shape[1:]
    ]
    joined = xr.concat([down[both], branch[both]], dim="point")
    return branch.drop_dims("point").assign(joined)


def _load(path: Path, needs: Sequence[str]) -> xr.Dataset:
    """Return the branch in ``path`` with the kinds of its points in words."""
    with open_netcdf(path, "branch", needs) as file:
        branch = file.load()
    return branch.assign(kind=("point", kind_names(branch)))


def _holds(branch: xr.Dataset, beginning: str) -> bool:
    """Return whether the name of any variable of ``branch`` has this ``beginning``."""
    return any(str(name).startswith(beginning) for name in branch.variables)


def _heading(branch: xr.Dataset, with_law: bool) -> str:
    """Return the branch's name, its law if it is to be named, and its reading."""
    table = tomllib.loads(branch.attrs.get("case", ""))
    lattice = table.get("lattice", {})
    parts = [branch.attrs["name"]]
    if with_law:
        parts.append(table.get("contacts", {}).get("law", ""))

    # Only the paper's parameters have a reading, not a user-defined cell or system.
    is_custom = "cell" in lattice or table.get("nnm", {}).get("system") == "own"
    if not is_custom:
        parts.append(lattice.get("reading", ""))
    return ", ".join(part for part in parts if part)


def _label_narrow_energies(axes: Axes, energy: np.ndarray) -> None:
    """Label an axis of less than a decade, where matplotlib's logarithmic axes have no labels or too many."""
    if energy.max() >= 10 * energy.min():
        return
    very_narrow = energy.max() < 3 * energy.min()
    axes.xaxis.set_major_locator(MaxNLocator(4) if very_narrow else LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FormatStrFormatter("%.4g"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def frequency_energy(axes: Axes, branch: xr.Dataset) -> None:
    """Draw frequency over energy.

    Special points are marked if there are few, and an inset shows grazing; otherwise tongues are labelled instead.
    """
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    kind = branch["kind"].values
    few_marks = np.isin(kind, list(MARKS)).sum() <= MOST_MARKS
    _shade(axes, branch)
    draw_branch(axes, branch)

    if few_marks:
        for name, (mark, label) in MARKS.items():
            is_marked = kind == name
            if is_marked.any():
                axes.plot(energy[is_marked], frequency[is_marked], mark, ms=3, label=label, **HOLLOW)
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
        # The lower right is free below a branch that rises over the energy; one that falls or has a constant frequency
        # lies there, and tongues may.
        rises = frequency[energy.argmax()] > frequency[energy.argmin()]
        lower_right_is_free = rises and (few_marks or not touched.size)
        axes.legend(loc="lower right" if lower_right_is_free else "best", fontsize=5.5)


def _label_tongue(axes: Axes, branch: xr.Dataset, order: int) -> None:
    """Write "k:1" for k = ``order`` above the fold of this tongue with the highest frequency, if the branch has one."""
    k = branch["resonance"].values

    # Tongues follow each other in the order of k. A fold with this k after one with a higher k is not the tip of this
    # tongue: it lies between one tongue and the next.
    higher = np.nonzero(k > order)[0]
    end = higher[0] if higher.size else len(k)
    tongue = branch.isel(point=(k == order) & (np.arange(len(k)) < end))
    if tongue.sizes["point"]:
        tip = tongue.isel(point=int(np.argmax(tongue["frequency"].values)))
        position = float(tip["energy"]), float(tip["frequency"])
        note(axes, f"{order}:1", position, (1, 3), fontsize=5.5, color=style.GREY, ha="center")


def slope(axes: Axes, branch: xr.Dataset) -> None:
    """Draw |df/dE| over energy at regular points: at those with contact, or at all if the branch has no contact.

    Where the branch has several states of one energy, that of the lowest frequency is blue and the others are pale. The
    pale line joins all points that are shown.
    """
    _shade(axes, branch)
    shown = branch["kind"].values == "regular"
    touches = branch["contacts"].values > 0
    if touches.any():
        shown &= touches
    energy = branch["energy"].values[shown]
    steepness = np.abs(branch["slope"].values)[shown]
    is_lowest = lowest(branch)[shown]
    if not np.any(steepness * energy > ROUNDING * branch["frequency"].values[shown]):
        # A logarithmic axis has no place for 0. The axis of the energy stays, as panels below may share it.
        axes.set(yticks=[], ylabel=SLOPE)
        reason = "the frequency does not change with the energy"
        axes.text(0.5, 0.5, reason, ha="center", va="center", color=style.GREY, transform=axes.transAxes)
        return

    label = None
    if not is_lowest.all():
        axes.loglog(energy, steepness, lw=0.4, color=style.SKY, label="other states at the same energy")
        label = "lowest frequency at this energy"
    axes.loglog(energy, np.where(is_lowest, steepness, np.nan), lw=1.1, color=style.BLUE, label=label)
    if label:
        axes.legend(loc="lower left", fontsize=5.5)
    axes.set_ylabel(SLOPE)


def portraits(part: SubFigure, branch: xr.Dataset, tag: str) -> None:
    """Draw the first two masses of the first four orbits in the file, where one of every region comes first."""
    if "orbits/number" not in branch:
        annotate_empty(part.subplots(), "no orbits stored")
        return

    stored = branch.sizes["orbit"]
    orbits = branch.isel(orbit=slice(MOST_ORBITS))
    regular = branch.isel(point=branch["kind"].values == "regular")
    grid = part.subplots(1, orbits.sizes["orbit"], sharey=True, squeeze=False)[0]
    for k, axes in enumerate(grid):
        energy = orbits["orbits/energy"].values[k]
        _draw_orbit(axes, orbits["orbits/displacement"].values[k], orbits["orbits/velocity"].values[k])

        # An orbit has the number of its regular point, or of the next one. Its energy may be that of other points, too.
        number = orbits["orbits/number"].values[k]
        nearest = int(np.abs(regular["number"].values - number).argmin())
        region = REGIONS[int(regular["region"][nearest])]
        rounded = float(f"{energy:.2g}")
        axes.set_title(f"{region}\n{style.with_prefix(rounded, 'J')}", loc="center", fontsize=7)
        axes.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), xticks=[-1, 1], yticks=[-1, 1], box_aspect=1)
    grid[0].set_ylabel(r"$\dot u$/max")
    heading = f"({tag}) Orbits"
    if stored > MOST_ORBITS:
        heading += f", {MOST_ORBITS} of {stored} in the file"
    part.suptitle(heading, x=0.02, ha="left")
    part.supxlabel(r"$u$/max (solid: mass 1, dashed: mass 2)", fontsize=7)


def _draw_orbit(axes: Axes, u: np.ndarray, v: np.ndarray) -> None:
    """Draw the first two masses of an orbit, ``u`` and ``v`` (phase, mass), over the largest of all its masses."""
    x = np.vstack([u, u[:1]]) / np.abs(u).max()  # closed
    y = np.vstack([v, v[:1]]) / np.abs(v).max()
    looks = ((style.BLUE, "-"), (style.VERMILION, "--"))
    for mass, (colour, dashes) in zip(range(u.shape[1]), looks, strict=False):
        axes.plot(x[:, mass], y[:, mass], color=colour, lw=0.8, ls=dashes)


def _grazing_inset(axes: Axes, branch: xr.Dataset, first: int) -> None:
    """Draw the neighbourhood of the point ``first``, where contact begins, in an inset that covers least of the branch.

    The inset shows the branch up to where the frequency differs by a tenth from that of the last energy fold, or of the
    point ``first`` if there is no fold, but at least three points beyond ``first``. If the frequency differs by so much
    nowhere, the inset ends where it has changed by a tenth of its largest change.
    """
    energy = branch["energy"].values
    frequency = branch["frequency"].values
    folds = np.nonzero(branch["kind"].values == "fold-energy")[0]
    last = int(folds[-1]) if folds.size else first
    # A tenth beyond the fold the branch has its trend again, up or down, which the panel shows.
    is_beyond = (frequency[last:] >= 1.1 * frequency[last]) | (frequency[last:] <= frequency[last] / 1.1)
    if not is_beyond.any():
        change = np.abs(frequency[last:] - frequency[last])
        is_beyond = change >= change.max() / 10
    last += int(np.argmax(is_beyond))
    last = min(max(last, first + 3), len(energy) - 1)
    near = branch.isel(point=slice(max(first - 1, 0), last + 1))

    inset = axes.inset_axes(_free_place(axes, np.column_stack(smooth(branch))))
    draw_branch(inset, near, width=0.9)
    at_fold = near["kind"].values == "fold-energy"
    inset.plot(near["energy"][at_fold], near["frequency"][at_fold], "o", ms=2.5, **HOLLOW)
    inset.margins(0.1)
    inset.tick_params(labelsize=5, pad=1.5)
    inset.locator_params(axis="both", nbins=3)
    inset.set_title("grazing", fontsize=6, pad=1.5)


def _free_place(axes: Axes, curve: np.ndarray) -> tuple[float, float, float, float]:
    """Return left, bottom, width and height, in fractions of ``axes``, of an inset off the drawn ``curve`` (point, 2).

    It is the largest that covers nothing of the curve, and of several the rightmost, then the lowest; if all cover
    something, it is the one that covers least.
    """
    # ``transData`` has the limits of when they were last asked for, which may be before the curve was drawn.
    axes.get_ylim()
    corners = axes.transAxes.inverted().transform(axes.transData.transform(curve))
    # Points at equal distances along the curve: the number of them in a place says how much of the curve is there.
    position = np.append(0.0, np.cumsum(np.hypot(*np.diff(corners, axis=0).T)))
    along = np.linspace(0.0, position[-1], CURVE_POINTS)
    points = np.column_stack([np.interp(along, position, values) for values in corners.T])

    # From the largest size down, and from the right to the left: the first position that covers nothing is the best.
    least = (len(points) + 1, (0.0, 0.0, *INSET))
    for scale in SHRINKING:
        size = scale * np.array(INSET)
        low, high = (np.array(margin) for margin in MARGINS)
        for left in np.linspace(1 - high[0] - size[0], low[0], PLACES):
            for bottom in np.linspace(low[1], 1 - high[1] - size[1], PLACES):
                begin = np.array([left, bottom])
                # Not over the legend, which stands in the upper left corner.
                if left < LEGEND[0] and bottom + size[1] > LEGEND[1]:
                    continue
                inside = np.all((points > begin - low) & (points < begin + size + high), axis=1)
                covered = int(inside.sum())
                if covered < least[0]:
                    least = covered, (left, bottom, *size)
        if least[0] == 0:
            break
    return least[1]


def _shade(axes: Axes, branch: xr.Dataset) -> None:
    """Shade the regions as bands of energy, unless region III is missing.

    A branch that internal resonances lead through tongue after tongue stays in region II, which then has no end.
    """
    energy = branch["energy"].values
    region = branch["region"].values
    if np.any(region == 3):
        left = energy[region == region.min()].min()
        shade_regions(axes, energy, region, left, at_top=True)
