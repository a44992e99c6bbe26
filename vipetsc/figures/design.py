"""The (lambda, eta) search: Bloch deflections, cost maps with their optima, dispersion against the parameters."""

from __future__ import annotations

import h5py
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.bands import BRANCHES

WEIGHTED = 2  # place of the weighted cost among the costs
TITLES = {"deflection": "Deflection", "group_velocity": "Group velocity", "weighted": "Weighted"}
LABELS = {"deflection": "max w (1)", "group_velocity": "Σ max |v$_g$| (cells/s)", "weighted": "cost (cells/s)"}
LINES = 10  # values of the parameter that is followed
HEADROOM = 1.9  # frequencies are shown up to this many times the best cell's highest
KAPPA = "Wavenumber κ (π rad/cell)"
OMEGA = "ω (krad/s)"


def deflections(file: h5py.File) -> Figure:
    """Bloch displacements of the masses and the resonator's deflection on each band at the weighted optimum."""
    readings, kappa = _readings(file), file["wavenumber"][...] / np.pi
    bands = file["band"][...]
    figure = style.new_figure(style.PAGE, 1.1 + 1.55 * len(readings))
    panels = figure.subplots(len(readings), len(bands), sharex=True, sharey=True, squeeze=False)
    for i, reading in enumerate(readings):
        for j, band in enumerate(bands):
            axes = panels[i, j]
            u = file["optimum_amplitude"][i, WEIGHTED, :, :, j]
            w = file["optimum_deflection"][i, WEIGHTED, :, j]
            against = np.where(w > 0, -1.0, 1.0)
            axes.axhline(0, color=style.GREY, lw=0.5)
            axes.plot(kappa, np.abs(w), color=style.BLACK, lw=1.6, label="w = |$u_3 - u_2$|")
            axes.plot(kappa, u[:, 0], color=style.ORANGE, label="$u_1$")
            axes.plot(kappa, u[:, 1], color=style.BLUE, label="$u_2$")
            axes.plot(kappa, against * u[:, 2], color=style.VERMILION, label="$u_3$, negative where against $u_2$")
            axes.plot(kappa, u[:, 3], color=style.GREEN, ls=(0, (3, 2)), label="$u_4$")
            style.letter(axes, f"Band {band}")
        lam, eta = (file[f"optimum_{name}"][i, WEIGHTED] for name in ("lambda", "eta"))
        panels[i, 0].set_ylabel(f"{reading.capitalize()}\nλ = {lam:.3g}, η = {eta:.3g}\n|u| (unit norm)")
    panels[0, 0].set(xlim=(0, 1), xticks=(0, 0.5, 1))
    figure.supxlabel(KAPPA, fontsize=8)
    figure.get_layout_engine().set(rect=(0, 0, 1, 1 - 0.22 / figure.get_figheight()))
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="upper center", ncols=5)
    return figure


def cost_maps(file: h5py.File) -> Figure:
    """The three costs over (lambda, eta), the best cell of each marked, its dispersion inset.

    Cells whose host and resonator are not out of phase all along the second band are veiled.
    """
    readings, costs = _readings(file), file["cost"].asstr()[...]
    lam, eta = file["lambda"][...], file["eta"][...]
    figure = style.new_figure(style.PAGE, 0.6 + 2.1 * len(readings))
    panels = figure.subplots(len(readings), len(costs), sharex=True, sharey=True, squeeze=False)
    for i, reading in enumerate(readings):
        feasible = file["out_of_phase"][i].T.astype(bool)
        veil = np.ma.masked_array(np.zeros(feasible.shape), feasible)
        for j, cost in enumerate(costs):
            axes = panels[i, j]
            values = file[cost][i].T
            judged = values[feasible] if feasible.any() else values
            # Elsewhere the sign makes a cost that knows the deflection meaningless.
            shown = values if cost == "group_velocity" else np.where(feasible, values, np.nan)
            image = style.draw_map(axes, lam, eta, shown, Normalize(judged.min(), judged.max()), "viridis")
            axes.imshow(veil, extent=image.get_extent(), origin="lower", aspect="auto", alpha=0.75,
                        cmap=ListedColormap([style.PALE]), interpolation="nearest")  # fmt: skip
            figure.colorbar(image, ax=axes, label=LABELS[cost], pad=0.02)
            at = file["optimum_lambda"][i, j], file["optimum_eta"][i, j]
            if np.isnan(at).any():
                style.letter(axes, f"{TITLES[cost]}: none is out of phase")
                continue
            axes.plot(*at, "s", color="red", mec="white", mew=0.6, ms=5, clip_on=False, zorder=5)
            style.letter(axes, f"{TITLES[cost]}: ({at[0]:.3g}, {at[1]:.3g})")
            _inset(axes, file, i, at)
        panels[i, 0].set_ylabel(f"{reading.capitalize()}\nη")
    figure.supxlabel("λ  (pale: $u_2$ and $u_3$ are not out of phase all along band 2)", fontsize=8)
    return figure


def _inset(axes: Axes, file: h5py.File, reading: int, at: tuple[float, float]) -> None:
    """The dispersion of the cell ``at`` (lambda, eta), in the corner where cells are veiled."""
    row, column = _nearest(file, *at)
    inset = axes.inset_axes((0.5, 0.1, 0.46, 0.46))
    kappa, frequency = file["wavenumber"][...] / np.pi, file["frequency"][reading, row, column] / 1e3
    for band, branch in enumerate(frequency.T):
        inset.plot(kappa, branch, color=BRANCHES[band % len(BRANCHES)], lw=0.8)
    inset.set(xlim=(0, 1), ylim=(0, None), xticks=(), yticks=())
    inset.set_xlabel("κ", labelpad=1, fontsize=6.5)
    inset.set_ylabel("ω", labelpad=1, fontsize=6.5)


def dispersion_against_lambda(file: h5py.File) -> Figure:
    """Bands of cells from the smallest to the largest lambda: least, best or middle, and greatest eta."""
    return _dispersions(file, "lambda", "eta")


def dispersion_against_eta(file: h5py.File) -> Figure:
    """Bands of cells from the smallest to the largest eta: least, best or middle, and greatest lambda."""
    return _dispersions(file, "eta", "lambda")


def _dispersions(file: h5py.File, along: str, beside: str) -> Figure:
    """Cells along one parameter, with the other at its least, best (or middle) and greatest value."""
    symbols = {"lambda": "λ", "eta": "η"}
    readings, kappa = _readings(file), file["wavenumber"][...] / np.pi
    values, others = file[along][...], file[beside][...]
    colours, norm = mpl.colormaps["plasma"], Normalize(values[0], values[-1] + 0.08 * (values[-1] - values[0]))
    figure = style.new_figure(style.PAGE, 0.6 + 2.0 * len(readings))
    panels = figure.subplots(len(readings), 3, sharex=True, sharey=True, squeeze=False)
    for i, reading in enumerate(readings):
        row, column = _best(file, i)
        middle = column if beside == "eta" else row
        top = HEADROOM * file["frequency"][i, row, column].max() / 1e3
        last = len(others) - 1
        middle = middle if 0 < middle < last else last // 2
        for axes, place in zip(panels[i], (0, middle, last), strict=True):
            taken = file["frequency"][i, :, place] if along == "lambda" else file["frequency"][i, place]
            for index in _spread(len(values), LINES):
                axes.plot(kappa, taken[index] / 1e3, color=colours(norm(values[index])), lw=0.7)
            style.letter(axes, f"{symbols[beside]} = {others[place]:.3g}")
            if taken.max() / 1e3 > top:
                axes.set_title(f"up to {taken.max() / 1e3:.3g} krad/s ↑", loc="right", pad=3, fontsize=6.5)
        panels[i, 0].set(ylabel=f"{reading.capitalize()}\n{OMEGA}", ylim=(0, top))
    panels[0, 0].set(xlim=(0, 1), xticks=(0, 0.5, 1))
    figure.supxlabel(KAPPA, fontsize=8)
    shades = mpl.cm.ScalarMappable(Normalize(values[0], values[-1]), ListedColormap(colours(np.linspace(0, 0.93, 256))))
    figure.colorbar(shades, ax=panels, label=symbols[along], pad=0.01)
    return figure


def _best(file: h5py.File, reading: int) -> tuple[int, int]:
    """Place (lambda, eta) of a reading's weighted optimum; the middle of the grid if there is none."""
    at = [file[f"optimum_{name}"][reading, WEIGHTED] for name in ("lambda", "eta")]
    if np.isnan(at).any():
        return len(file["lambda"]) // 2, len(file["eta"]) // 2
    return _nearest(file, *at)


def _nearest(file: h5py.File, lam: float, eta: float) -> tuple[int, int]:
    """Place in the grid of the cell nearest to (lambda, eta)."""
    return tuple(int(np.argmin(np.abs(file[n][...] - v))) for n, v in (("lambda", lam), ("eta", eta)))


def _spread(length: int, count: int) -> list[int]:
    """At most ``count`` indices below ``length``, evenly spaced, both ends among them."""
    return sorted({int(i) for i in np.round(np.linspace(0, length - 1, min(count, length)))})


def _readings(file: h5py.File) -> list[str]:
    return list(file["reading"].asstr()[...])
