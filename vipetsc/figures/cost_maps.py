"""The (lambda, eta) search: Bloch deflections, cost maps with optima, dispersion against the parameters (Fig. S3).

The search and its costs are those of ``vipetsc.paper.cell_costs``. Of the four masses u1 to u4 of a cell, u2 is the
host of the resonator u3; lambda is the stiffness of the resonator's spring over that of a spring of the lattice, eta
the resonator's part of the mass of both. A cell is feasible if host and resonator move out of phase at every wavenumber
of the second band.
"""

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.page import Page
from vipetsc.figures.panels import KAPPA, colour_bar, draw_map

WEIGHTED = 2  # index of the weighted cost along the dimension ``cost``
TITLES = {"deflection": "Deflection", "group_velocity": "Group velocity", "weighted": "Weighted"}
LABELS = {"deflection": "max w (1)", "group_velocity": "Σ max |v$_g$| (cells/s)", "weighted": "cost (cells/s)"}
SYMBOLS = {"lambda": "λ", "eta": "η"}
MASSES = ("$u_1$", "$u_2$", "$u_3$, negative if out of phase with $u_2$", "$u_4$")
LINES = 10  # values of the parameter that have a curve in a panel: colours of more could not be told apart
# Frequencies are shown up to this many times the highest one of the best cell: some cells of the grid have bands that
# are many times higher, in whose panels all others would be flat.
HEADROOM = 1.9


def deflections(search: xr.Dataset) -> Figure:
    """Draw Bloch displacements of the masses and the resonator's deflection on each band at the weighted optimum."""
    optimum = search.isel(cost=WEIGHTED)
    kappa = search["wavenumber"].values / np.pi
    page = _page(search, columns=search.sizes["band"], margin=0.9, height=1.55, xlabel=KAPPA, legend=1)
    for (i, j), axes in np.ndenumerate(page.grid):
        cell = optimum.isel(reading=i, band=j)
        deflection = cell["optimum_deflection"].values
        amplitude = cell["optimum_amplitude"].values.copy()
        # Amplitudes are moduli, 0 or more. The resonator's is given a sign: negative where it moves against its host,
        # for which the deflection in the file is positive.
        amplitude[:, 2] = np.where(deflection > 0, -amplitude[:, 2], amplitude[:, 2])

        axes.axhline(0, color=style.GREY, lw=0.5)
        axes.plot(kappa, np.abs(deflection), color=style.BLACK, lw=1.6, label="w = |$u_3 - u_2$|")
        *_, last = axes.plot(kappa, amplitude, label=MASSES)
        # The curve of the last mass often lies on that of the first.
        last.set_linestyle("--")
        axes.set_title(f"Band {cell['band'].item()}")
        if j == 0:
            best = f"λ = {cell['optimum_lambda'].item():.3g}, η = {cell['optimum_eta'].item():.3g}"
            axes.set_ylabel(f"{cell['reading'].item().capitalize()}\n{best}\n|u| (unit norm)")

    page.panels[0].set(xlim=(0, 1), xticks=(0, 0.5, 1))
    handles, labels = page.panels[0].get_legend_handles_labels()
    page.write_legend(handles, labels, columns=5)
    return page.lettered()


def cost_maps(search: xr.Dataset) -> Figure:
    """Draw the three costs over (lambda, eta), the best cell of each marked, its dispersion inset.

    Cells whose host and resonator are not out of phase all along the second band are veiled.
    """
    xlabel = "λ  (pale: $u_2$ and $u_3$ are not out of phase throughout band 2)"
    page = _page(search, columns=search.sizes["cost"], margin=0.6, height=2.1, xlabel=xlabel)
    for (i, j), axes in np.ndenumerate(page.grid):
        result = search.isel(reading=i, cost=j)
        cost = str(result["cost"].item())
        _draw_cost(axes, result, cost)

        best = {name: result[f"optimum_{name}"].item() for name in SYMBOLS}
        if np.isnan(list(best.values())).any():
            axes.set_title(f"{TITLES[cost]}: none is out of phase")
        else:
            axes.set_title(f"{TITLES[cost]}:\n({best['lambda']:.3g}, {best['eta']:.3g})")
            _draw_best(axes, result, best)

        if j == 0:
            axes.set_ylabel(f"{result['reading'].item().capitalize()}\nη")
    return page.lettered()


def _draw_cost(axes: Axes, result: xr.Dataset, cost: str) -> None:
    """Draw the map of a ``cost``, its colours from the feasible cells alone, and a veil over the others."""
    feasible = result["out_of_phase"].values.T.astype(bool)
    values = result[cost].values.T
    # Without a feasible cell all of them set the colours.
    in_range = values[feasible] if feasible.any() else values
    norm = Normalize(np.nanmin(in_range), np.nanmax(in_range))

    # The other costs hold the signed deflection, whose largest value means nothing where the sign changes.
    shown = values
    if cost != "group_velocity":
        shown = np.where(feasible, values, np.nan)
    image = draw_map(axes, result["lambda"].values, result["eta"].values, shown, norm, "viridis")
    veil = np.ma.masked_where(feasible, np.zeros(feasible.shape))
    axes.imshow(veil, extent=image.get_extent(), alpha=0.75, cmap=ListedColormap([style.PALE]))
    colour_bar(image, axes, LABELS[cost], extend="neither")


def _draw_best(axes: Axes, result: xr.Dataset, best: dict[str, float]) -> None:
    """Mark the best cell, and draw its dispersion in the lower right corner, where cells are veiled."""
    look = {"color": "red", "mec": "white", "mew": 0.6, "ms": 5, "clip_on": False, "zorder": 5}
    axes.plot(best["lambda"], best["eta"], "s", **look)
    cell = result.sel(best, method="nearest")
    inset = axes.inset_axes((0.5, 0.1, 0.46, 0.46))
    for number, frequency in enumerate(cell["frequency"].transpose("band", ...).values, 1):
        inset.plot(cell["wavenumber"] / np.pi, frequency, color=style.band_colour(number), lw=0.8)
    inset.set(xlim=(0, 1), ylim=(0, None), xticks=(), yticks=(), xlabel="κ", ylabel="ω")


def dispersions(search: xr.Dataset, along: str, other: str) -> Figure:
    """Draw the bands of ``LINES`` cells between the least and the greatest value of the parameter ``along``.

    A row for each reading has panels for the least, the best and the greatest value of the parameter ``other``.
    """
    values = search[along].values
    lines = np.unique(np.round(np.linspace(0, len(values) - 1, min(LINES, len(values)))).astype(int))
    # Without the brightest yellow, which is not seen on white paper.
    shades = ListedColormap(mpl.colormaps["plasma"](np.linspace(0, 0.93, 256)))
    colours = mpl.cm.ScalarMappable(Normalize(values[0], values[-1]), shades)
    # Each row has limits of its own, those for the best cell of its reading.
    page = _page(search, columns=3, margin=0.6, height=2.0, xlabel=KAPPA, sharey="row")
    for i, row in enumerate(page.grid):
        result = search.isel(reading=i)
        best = _best_cell(result)
        last = search.sizes[other] - 1
        # If the best value is the least or the greatest, it has a panel already.
        middle = best[other] if 0 < best[other] < last else last // 2

        top = HEADROOM * float(result["frequency"].isel(best).max()) / 1e3
        for axes, index in zip(row, (0, middle, last), strict=True):
            cells = result.isel({other: index})
            frequency = cells["frequency"].values / 1e3
            kappa = cells["wavenumber"].values / np.pi
            for line in lines:
                axes.plot(kappa, frequency[line], color=colours.to_rgba(values[line]), lw=0.7)
            axes.set_title(f"{SYMBOLS[other]} = {cells[other].item():.3g}")
            # Curves that leave the panel are announced with how far they go.
            if frequency.max() > top:
                axes.set_title(f"up to {frequency.max():.3g} krad/s ↑", loc="right", fontsize=6.5)
        row[0].set(ylabel=f"{result['reading'].item().capitalize()}\nω (krad/s)", ylim=(0, top))

    page.panels[0].set(xlim=(0, 1), xticks=(0, 0.5, 1))
    colour_bar(colours, page.grid, SYMBOLS[along], extend="neither")
    return page.lettered()


def _best_cell(result: xr.Dataset) -> dict[str, int]:
    """Return the indices of the weighted optimum by parameter; of the middle where no cell is feasible."""
    optimum = {name: result[f"optimum_{name}"].values[WEIGHTED] for name in SYMBOLS}
    if np.isnan(list(optimum.values())).any():
        return {name: result.sizes[name] // 2 for name in SYMBOLS}
    return {name: int(np.abs(result[name].values - value).argmin()) for name, value in optimum.items()}


def _page(
    search: xr.Dataset,
    columns: int,
    margin: float,
    height: float,
    xlabel: str,
    sharey: bool | str = True,
    legend: int = 0,
) -> Page:
    """Return a page with a row of panels, ``height`` inches high, for every reading.

    ``margin`` in inches is room for what stands above and below all, such as ``xlabel``; ``sharey`` is that of
    ``Figure.subplots``, ``legend`` the number of its lines.
    """
    rows = search.sizes["reading"]
    page = Page.of(rows, columns, height=margin + height * rows, legend=legend, sharex=True, sharey=sharey)
    page.body.supxlabel(xlabel)
    return page
