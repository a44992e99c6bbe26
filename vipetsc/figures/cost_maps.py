"""The (lambda, eta) search: Bloch deflections, cost maps with optima, dispersion against the parameters (Fig. S3)."""

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.panels import KAPPA, colour_bar, draw_map

WEIGHTED = 2  # index of the weighted cost
TITLES = {"deflection": "Deflection", "group_velocity": "Group velocity", "weighted": "Weighted"}
LABELS = {"deflection": "max w (1)", "group_velocity": "Σ max |v$_g$| (cells/s)", "weighted": "cost (cells/s)"}
SYMBOLS = {"lambda": "λ", "eta": "η"}
LINES = 10  # values of the parameter that is followed
HEADROOM = 1.9  # frequencies are shown up to this many times the best cell's highest


def deflections(search: xr.Dataset) -> Figure:
    """Bloch displacements of the masses and the resonator's deflection on each band at the weighted optimum."""
    optimum, kappa = search.isel(cost=WEIGHTED), search["wavenumber"].values / np.pi
    figure, grid = _grid(search, search.sizes["band"], 1.1, 1.55, KAPPA)
    labels = "$u_1$", "$u_2$", "$u_3$, negative where against $u_2$", "$u_4$"
    for (i, j), axes in np.ndenumerate(grid):
        cell = optimum.isel(reading=i, band=j)
        u, w = cell["optimum_amplitude"].values.copy(), cell["optimum_deflection"].values
        u[:, 2] = np.where(w > 0, -u[:, 2], u[:, 2])
        axes.axhline(0, color=style.GREY, lw=0.5)
        axes.plot(kappa, np.abs(w), color=style.BLACK, lw=1.6, label="w = |$u_3 - u_2$|")
        *_, last = axes.plot(kappa, u, label=labels)
        last.set_linestyle("--")  # it often lies on that of the first mass
        axes.set_title(f"Band {cell['band'].item()}")
        if j == 0:
            best = f"λ = {cell['optimum_lambda'].item():.3g}, η = {cell['optimum_eta'].item():.3g}"
            axes.set_ylabel(f"{cell['reading'].item().capitalize()}\n{best}\n|u| (unit norm)")
    grid[0, 0].set(xlim=(0, 1), xticks=(0, 0.5, 1))
    figure.get_layout_engine().set(rect=(0, 0, 1, 1 - 0.22 / figure.get_figheight()))
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="upper center", ncols=5)
    return figure


def cost_maps(search: xr.Dataset) -> Figure:
    """The three costs over (lambda, eta), the best cell of each marked, its dispersion inset.

    Cells whose host and resonator are not out of phase all along the second band are veiled.
    """
    lam, eta = search["lambda"].values, search["eta"].values
    xlabel = "λ  (pale: $u_2$ and $u_3$ are not out of phase all along band 2)"
    figure, grid = _grid(search, search.sizes["cost"], 0.6, 2.1, xlabel)
    for (i, j), axes in np.ndenumerate(grid):
        of_reading, cost = search.isel(reading=i), str(search["cost"].values[j])
        feasible, values = of_reading["out_of_phase"].values.T.astype(bool), of_reading[cost].values.T
        judged = values[feasible] if feasible.any() else values
        # Elsewhere the sign makes a cost that knows the deflection meaningless.
        shown = values if cost == "group_velocity" else np.where(feasible, values, np.nan)
        image = draw_map(axes, lam, eta, shown, Normalize(judged.min(), judged.max()), "viridis")
        veil = np.ma.masked_where(feasible, np.zeros(feasible.shape))
        axes.imshow(veil, extent=image.get_extent(), alpha=0.75, cmap=ListedColormap([style.PALE]))
        colour_bar(image, axes, LABELS[cost], extend="neither")
        best = tuple(of_reading[f"optimum_{name}"].values[j] for name in SYMBOLS)
        if np.isnan(best).any():
            axes.set_title(f"{TITLES[cost]}: none is out of phase")
        else:
            axes.plot(*best, "s", color="red", mec="white", mew=0.6, ms=5, clip_on=False, zorder=5)
            axes.set_title(f"{TITLES[cost]}: ({best[0]:.3g}, {best[1]:.3g})")
            # The dispersion of the best cell, in the corner where cells are veiled.
            cell = of_reading.sel({"lambda": best[0], "eta": best[1]}, method="nearest")
            inset = axes.inset_axes((0.5, 0.1, 0.46, 0.46))
            inset.plot(cell["wavenumber"] / np.pi, cell["frequency"].values, lw=0.8)
            inset.set(xlim=(0, 1), ylim=(0, None), xticks=(), yticks=(), xlabel="κ", ylabel="ω")
        if j == 0:
            axes.set_ylabel(f"{of_reading['reading'].item().capitalize()}\nη")
    return figure


def dispersions(search: xr.Dataset, along: str, other: str) -> Figure:
    """Bands of cells from the least to the greatest of one parameter, at the least, best and greatest of the other."""
    kappa, values = search["wavenumber"].values / np.pi, search[along].values
    lines = np.unique(np.round(np.linspace(0, len(values) - 1, min(LINES, len(values)))).astype(int))
    shades = ListedColormap(mpl.colormaps["plasma"](np.linspace(0, 0.93, 256)))  # without what paper swallows
    colours = mpl.cm.ScalarMappable(Normalize(values[0], values[-1]), shades)
    figure, grid = _grid(search, 3, 0.6, 2.0, KAPPA)
    for i, row in enumerate(grid):
        of_reading = search.isel(reading=i)
        optimum = {name: of_reading[f"optimum_{name}"].values[WEIGHTED] for name in SYMBOLS}
        best = {name: int(np.abs(of_reading[name].values - value).argmin()) for name, value in optimum.items()}
        if np.isnan(list(optimum.values())).any():
            best = {name: of_reading.sizes[name] // 2 for name in SYMBOLS}
        top = HEADROOM * float(of_reading["frequency"].isel(best).max()) / 1e3
        last = search.sizes[other] - 1
        middle = best[other] if 0 < best[other] < last else last // 2
        for axes, index in zip(row, (0, middle, last), strict=True):
            cells = of_reading.isel({other: index})
            frequency = cells["frequency"].values / 1e3
            for line in lines:
                axes.plot(kappa, frequency[line], color=colours.to_rgba(values[line]), lw=0.7)
            axes.set_title(f"{SYMBOLS[other]} = {cells[other].item():.3g}")
            if frequency.max() > top:
                axes.set_title(f"up to {frequency.max():.3g} krad/s ↑", loc="right", fontsize=6.5)
        row[0].set(ylabel=f"{of_reading['reading'].item().capitalize()}\nω (krad/s)", ylim=(0, top))
    grid[0, 0].set(xlim=(0, 1), xticks=(0, 0.5, 1))
    colour_bar(colours, grid, SYMBOLS[along], extend="neither")
    return figure


def _grid(search: xr.Dataset, columns: int, margin: float, height: float, xlabel: str) -> tuple[Figure, np.ndarray]:
    """A page with a row of panels, ``height`` inches each, for every reading; ``xlabel`` stands below all."""
    rows = search.sizes["reading"]
    figure = style.new_figure(style.PAGE, margin + height * rows)
    figure.supxlabel(xlabel)
    return figure, figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
