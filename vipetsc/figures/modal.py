"""The energies of a run's linear modes: their steps at impacts, and what each site moved between the bands."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from vipetsc.figures import panels, style

COLOURS = style.GREY, style.BLUE, style.VERMILION, style.GREEN, style.PURPLE, style.ORANGE, style.SKY, style.YELLOW
LEAST = 1e-4  # share of the energy at the end or in transfers below which a gap is not drawn
MOST_ROWS = 24  # sites of a matrix; of more, the ones that moved most
SEVERAL = "several"  # sites in contact between the same samples


def modal_energies(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Energies of the linear modes by pass band over time, the impacts under them, and transfers by site and band."""
    if analysis is None or "bands/transfer" not in analysis:
        return panels.empty_figure("Modal energies: needs the analysis of a run with all displacements and velocities")
    energy, names = analysis["bands/modal_energy"], list(analysis["bands/modal_energy"].attrs["parts"])
    largest = float(energy.sum("bands/part").max())
    if largest == 0:
        return panels.empty_figure("Modal energies: the drive has done no work")
    weight = np.maximum(energy.values[:, -1], np.abs(analysis["bands/transfer"].values).sum(axis=0))
    shown = [p for p, name in enumerate(names) if "band" in name or weight[p] > LEAST * largest]
    rows, moved = _moved(run, analysis, shown)
    figure = style.new_figure(style.PAGE if rows else style.COLUMN, 3.3 if rows else 2.4)
    places = [["steps", "matrix"], ["impacts", "matrix"]] if rows else [["steps"]]
    ratios = {"width_ratios": (1.55, 1), "height_ratios": (2.6, 1)} if rows else {}
    axes = figure.subplot_mosaic(places, **ratios)
    steps, time = axes["steps"], analysis["bands/instant"]
    for p, colour in zip(shown, _colours(names, shown), strict=True):
        share = float(energy[p, -1] / energy[:, -1].sum())
        steps.plot(time, energy[p], color=colour, lw=0.9, label=f"{names[p]}: {share:.1%}")
    steps.set(ylabel="Energy of the linear modes (J)", xlim=run["time"][[0, -1]], ylim=(0, None))
    steps.legend(loc="best", ncols=1 + (len(shown) > 5), title="share at the end", title_fontsize=7)
    if not rows:
        steps.set(xlabel="Time (s)")
        return figure
    steps.set_title("(a) Steps at impacts")
    steps.tick_params(labelbottom=False)
    raster = axes["impacts"]
    raster.plot(run["impacts/onset"], run["impacts/site"], "|", color=style.BLACK, ms=4, mew=0.5)
    sites = run["sites/cell"].values
    some = np.unique(np.linspace(0, len(sites) - 1, min(len(sites), 6)).astype(int))
    raster.set_yticks(some + 1, sites[some])
    raster.set(xlabel="Time (s)", ylabel="Site (cell)", xlim=run["time"][[0, -1]], ylim=(0.4, len(sites) + 0.6))
    _matrix(axes["matrix"], rows, [*(names[p] for p in shown), "lost"], 100 * moved / float(run["energy/work"][-1]))
    return figure


def _colours(names: list[str], shown: list[int]) -> list[str]:
    """A colour for each part: bands in turn, what is no band in black."""
    bands = [name for name in names if "band" in name]
    return [COLOURS[bands.index(names[p]) % len(COLOURS)] if names[p] in bands else style.BLACK for p in shown]


def _moved(run: xr.Dataset, analysis: xr.Dataset, shown: list[int]) -> tuple[list[str], np.ndarray]:
    """Labels of the sites, and energies (site, part) in J that they moved, what was lost in the last column."""
    transfer, site = analysis["bands/transfer"].values, run["impacts/site"].values.astype(int) - 1
    cluster = analysis["bands/cluster_of_episode"].values - 1
    sites = run["sites/cell"].values
    lowest, highest = (np.full(len(transfer), start) for start in (len(sites), -1))
    np.minimum.at(lowest, cluster, site)
    np.maximum.at(highest, cluster, site)
    row = np.where(lowest == highest, lowest, len(sites))
    moved = np.zeros((len(sites) + 1, len(shown) + 1))
    np.add.at(moved, row, np.column_stack([transfer[:, shown], -transfer.sum(axis=1)]))
    keep = np.unique(row)
    keep = np.sort(keep[np.argsort(-np.abs(moved[keep]).sum(axis=1), kind="stable")][:MOST_ROWS])
    labels = [*map(str, sites), SEVERAL]
    return [labels[i] for i in keep], moved[keep]


def _matrix(axes: Axes, rows: list[str], columns: list[str], share: np.ndarray) -> None:
    """Shares (site, part) of the work in % as a matrix with numbers."""
    top = max(float(np.abs(share).max()), 1e-300)
    axes.imshow(share, cmap="RdBu_r", norm=SymLogNorm(top / 10, vmin=-top, vmax=top), aspect="auto", origin="upper")
    wide, size = len(columns) > 7, 5 if len(rows) > 12 or len(columns) > 7 else 7
    for (y, x), value in np.ndenumerate(share):
        text = f"{value:+.{1 if wide and abs(value) >= 9.995 else 2}f}" if abs(value) >= 0.005 else "0"
        colour = "white" if abs(value) > 0.35 * top else style.BLACK
        axes.text(x, y, text, ha="center", va="center", fontsize=size, color=colour)
    axes.set_xticks(range(len(columns)), columns, rotation=40, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows, fontsize=6 if len(rows) > 12 else 8)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.set(title="(b) Moved by each site (% of the work)", ylabel="Contact site (cell)")
