"""The energy ledger: where the drive's work goes, and how well the sum closes."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.case import Case
from vipetsc.figures import style
from vipetsc.figures.panels import empty_figure

LARGEST_RESIDUAL = 1e-8  # over the work of the drive


def ledger(run: xr.Dataset, analysis: xr.Dataset | None) -> Figure:
    """Energies over time, and below them the residual relative to the work done, on a log scale."""
    time = run["time"].values
    kinetic, spring, contact, work, dissipated = (
        run[f"energy/{name}"].values for name in ("kinetic", "spring", "contact", "work", "dissipated")
    )
    largest = np.abs(work).max()
    if len(time) < 2 or largest == 0:
        return empty_figure("Energy ledger: the drive has done no work")
    figure = style.new_figure(style.COLUMN, 3.3)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (2.2, 1)})
    prefix, scale = _scaled(largest)
    # Both swing at twice the drive's frequency, which no page can resolve; means over two periods can be seen.
    window = int(np.ceil(4 * np.pi / Case.of(run).model().drive.frequency / (time[1] - time[0])))
    stored = kinetic + spring + contact
    curves = (
        ("work of the drive", work, style.BLACK, "-"),
        ("kinetic + potential", stored, style.BLUE, "-"),
        ("dissipated", dissipated, style.VERMILION, "-"),
        ("kinetic, mean", _running_mean(kinetic, window), style.SKY, "-"),
        ("springs, mean", _running_mean(spring, window), style.GREEN, (0, (3, 1.5))),
        ("contacts", contact, style.PURPLE, "-"),
    )
    for label, energy, colour, dashes in curves:
        upper.plot(time, energy * scale, color=colour, ls=dashes, label=label, lw=0.9)
    upper.set(ylabel=f"Energy ({prefix}J)", ylim=(-0.03 * largest * scale, 1.4 * largest * scale))
    upper.legend(loc="upper center", ncol=2, columnspacing=1.2, labelspacing=0.25)

    residual = np.abs(work - dissipated - stored) / largest
    lower.semilogy(time, np.maximum(residual, 1e-18), color=style.BLACK, lw=0.5)
    lower.axhline(LARGEST_RESIDUAL, color=style.VERMILION, lw=0.7, ls=style.DASHED)
    lower.annotate("limit 1e-8", (0.99, LARGEST_RESIDUAL), (0, 1.5), ha="right", va="bottom", fontsize=6.5,
                   xycoords=("axes fraction", "data"), textcoords="offset points", color=style.VERMILION)  # fmt: skip
    lower.set(xlabel="Time (s)", ylabel="|Residual| / work", xlim=time[[0, -1]])
    lower.set_ylim(1e-15, max(1e-6, 10 * residual.max()))
    return figure


def _scaled(value: float) -> tuple[str, float]:
    """SI prefix and factor that bring ``value`` to between 1 and 1000."""
    prefixes = (("", 1.0), ("m", 1e3), ("µ", 1e6), ("n", 1e9), ("p", 1e12))
    return next((pair for pair in prefixes if value * pair[1] >= 1), prefixes[-1])


def _running_mean(values: np.ndarray, samples: int) -> np.ndarray:
    """Mean over ``samples``, over fewer at the ends."""
    window = np.ones(min(samples, len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")
