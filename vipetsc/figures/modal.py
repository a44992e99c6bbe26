"""The energies of a run's linear modes: their steps at impacts, and the energy that each site transferred.

Without contacts, drives and dashpots each mode of the lattice keeps its energy. The modes are put together by the pass
band or gap in which their frequencies lie (*parts* of the spectrum). A *cluster* is a group of contact episodes between
the same two samples of the run, whose transfers cannot be told apart.
"""

from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page, add_letters
from vipetsc.figures.style import NoPicture

# Least energy of a gap that is drawn, at the end or summed over its transfers, over the largest energy that all
# modes have together: a line of less would be flat.
LEAST = 1e-4
# Sites of the matrix: its rows are then a letter high. Of more, those with the largest transfers are shown.
MOST_ROWS = 24
MOST_TICKS = 6  # labels of sites next to the panel of impacts, which is an inch high
SEVERAL = "several"  # the label of the row for clusters with episodes of several sites


class MovedEnergies(NamedTuple):
    """``energy`` (row, part + 1) in J that each site transferred to the parts of the spectrum, and lost (last column).

    ``labels`` (row) are the cells of the sites, or ``SEVERAL`` for clusters that cannot be separated by site. ``rows``
    is the number of rows that there would be without a limit.
    """

    labels: list[str]
    energy: np.ndarray
    rows: int

    @classmethod
    def of(cls, run: xr.Dataset, analysis: xr.Dataset, parts: list[int]) -> Self:
        """Return the energies that at most ``MOST_ROWS`` sites of ``run`` transferred to the ``parts``, by index."""
        # (cluster, part): the change of each part's energy during a cluster.
        transfer = analysis["bands/transfer"].values
        cluster = analysis["bands/cluster_of_episode"].values - 1
        site = run["impacts/site"].values.astype(int) - 1
        sites = run["sites/cell"].values

        # A cluster is of one site if the lowest and the highest site of its episodes are the same. By ``at``, since
        # several episodes change the entry of one cluster.
        lowest = np.full(len(transfer), len(sites))
        highest = np.full(len(transfer), -1)
        np.minimum.at(lowest, cluster, site)
        np.maximum.at(highest, cluster, site)
        row = np.where(lowest == highest, lowest, len(sites))

        # From the log, not from what all parts together lose: the energy in a contact that is closed when the run
        # begins or ends is not dissipated. Clusters of several sites have a row behind those of the sites.
        # An episode that has not ended has no loss.
        lost = np.bincount(cluster, np.nan_to_num(run["impacts/loss"].values), len(transfer))
        moved = np.zeros((len(sites) + 1, len(parts) + 1))
        np.add.at(moved, row, np.column_stack([transfer[:, parts], lost]))

        rows = np.unique(row)
        by_size = np.argsort(-np.abs(moved[rows]).sum(axis=1), kind="stable")
        shown = np.sort(rows[by_size][:MOST_ROWS])
        labels = [*panels.site_labels(run), SEVERAL]
        return cls(labels=[labels[i] for i in shown], energy=moved[shown], rows=len(rows))


def modal_energies(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Draw energies of the linear modes by pass band over time, the impacts below, and transfers by site and band."""
    if not Case.of(run).model().chain.cell.joins_cells:
        raise NoPicture("a lattice without springs from cell to cell has no bands")
    if analysis is None or "bands/transfer" not in analysis:
        raise NoPicture("needs the analysis of a run with all displacements and velocities")
    if not analysis["bands/modal_energy"].values.any():
        raise NoPicture("the drive did no work")

    energy = analysis["bands/modal_energy"]
    largest = float(energy.sum("bands/part").max())

    # Bands are always drawn, gaps only if their energy can be seen. A gap may have given back by the end all that it
    # took: its transfers count as well.
    names = list(energy.attrs["parts"])
    weight = np.maximum(energy.values[:, -1], np.abs(analysis["bands/transfer"].values).sum(axis=0))
    parts = [p for p, name in enumerate(names) if "band" in name or weight[p] > LEAST * largest]
    moved = MovedEnergies.of(run, analysis, parts)
    if not moved.labels:
        page = Page.of(height=2.4)
        (axes,) = page.panels
        _draw_steps(axes, run, analysis, parts)
        axes.set(xlabel="Time (s)")
        return page.lettered()

    figure = style.new_figure(style.PAGE, 3.3)
    ratios = {"width_ratios": (1.55, 1), "height_ratios": (2.6, 1)}
    panel = figure.subplot_mosaic([["steps", "matrix"], ["impacts", "matrix"]], **ratios)
    _draw_steps(panel["steps"], run, analysis, parts)
    panel["steps"].set_title("Steps at impacts")
    panel["impacts"].set_title("Impacts")
    panel["steps"].tick_params(labelbottom=False)
    _draw_impacts(panel["impacts"], run)
    percent = 100 * moved.energy / float(run["energy/work"][-1])
    _draw_matrix(panel["matrix"], moved.labels, [*(style.part_label(names[p]) for p in parts), "lost"], percent)
    panel["matrix"].set_ylabel(f"Contact site ({panels.sites_title(run)})")
    add_letters([panel["steps"], panel["impacts"], panel["matrix"]])
    if len(moved.labels) < moved.rows:
        style.add_note(figure, f"transfers: the {MOST_ROWS} of {moved.rows} rows with the largest ones")
    return figure


def _draw_steps(axes: Axes, run: xr.Dataset, analysis: xr.Dataset, parts: list[int]) -> None:
    """Draw the energies of ``parts`` over time; the legend has their fractions of all modal energy at the end."""
    energy = analysis["bands/modal_energy"]
    names = list(energy.attrs["parts"])
    at_end = energy[:, -1].sum()
    for p, look in zip(parts, _looks(names, parts), strict=True):
        fraction = float(energy[p, -1] / at_end)
        label = f"{style.part_label(names[p])}: {fraction:.1%}"
        axes.plot(analysis["bands/instant"], energy[p], lw=0.9, label=label, **look)
    axes.set(ylabel="Energy of the linear modes (J)", xlim=run["time"][[0, -1]], ylim=(0, None))
    axes.legend(loc="best", ncols=2 if len(parts) > 5 else 1, title="fraction at the end", title_fontsize=7)


def _looks(names: list[str], parts: list[int]) -> list[dict[str, Any]]:
    """Return colour and dashes for each of ``parts``: those of its band, or black and dotted for a gap."""
    looks = []
    for part in parts:
        number = style.band_number(names[part])
        looks.append(style.band_look(number) if number else {"color": style.BLACK, "ls": style.DOTTED})
    return looks


def _draw_impacts(axes: Axes, run: xr.Dataset) -> None:
    """Draw a stroke at the onset of every episode in the row of its site."""
    axes.plot(run["impacts/onset"], run["impacts/site"], "|", color=style.BLACK, ms=4, mew=0.5)
    sites = panels.site_labels(run)
    ticks = np.unique(np.linspace(0, len(sites) - 1, min(len(sites), MOST_TICKS)).astype(int))
    axes.set_yticks(ticks + 1, [sites[tick] for tick in ticks])
    axes.set(xlabel="Time (s)", xlim=run["time"][[0, -1]], ylim=(0.4, len(sites) + 0.6))
    axes.set_ylabel(f"Site ({panels.sites_title(run)})")


def _draw_matrix(axes: Axes, rows: list[str], columns: list[str], percent: np.ndarray) -> None:
    """Draw ``percent`` (site, part) of the work as a matrix with numbers."""
    # Linear within a tenth of the largest: small transfers of either sign keep a colour.
    top = max(float(np.abs(percent).max()), 1e-300)
    norm = SymLogNorm(top / 10, vmin=-top, vmax=top)
    image = axes.imshow(percent, cmap="RdBu_r", norm=norm, aspect="auto", origin="upper")

    is_wide = len(columns) > 7
    is_long = len(rows) > 12
    size = 5 if is_long or is_wide else 7
    for (y, x), value in np.ndenumerate(percent):
        colour = panels.text_colour(image.to_rgba(value))
        axes.text(x, y, _in_cell(value, is_wide), ha="center", va="center", fontsize=size, color=colour)
    axes.set_xticks(range(len(columns)), columns, rotation=40, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows, fontsize=6 if is_long else 8)
    axes.tick_params(length=0)
    axes.grid(visible=False)
    axes.set_title("Transferred by site (% of work)")


def _in_cell(value: float, is_wide: bool) -> str:
    """Return a percentage with its sign and two decimals, or one where a wide matrix has no room for five letters."""
    if abs(value) < 0.005:
        return "0"
    decimals = 1 if is_wide and abs(value) >= 9.995 else 2
    return f"{value:+.{decimals}f}"
