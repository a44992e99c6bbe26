"""The energy ledger: where the drive's work goes, and how well the sum closes."""

from __future__ import annotations

import h5py
import numpy as np
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.io.run_file import RunFile

PROMISE = 1e-8


def ledger(run: RunFile, analysis: h5py.File | None) -> Figure:
    """Energies over time, and below them the residual relative to the work done, on a log scale."""
    e, time = run.energies, run.time
    work = np.abs(e["work"]).max()
    if len(time) < 2 or work == 0:
        return style.without_data("Energy ledger: the drive has done no work")
    figure = style.new_figure(style.COLUMN, 3.3)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (2.2, 1)})
    prefix, scale = _scaled(work)
    # Both swing at twice the drive's frequency, which no page can resolve; means over two periods can be seen.
    window = int(np.ceil(4 * np.pi / run.model.drive.frequency / (time[1] - time[0])))
    stored = e["kinetic"] + e["spring"] + e["contact"]
    curves = (
        ("work of the drive", e["work"], style.BLACK, "-"),
        ("kinetic + potential", stored, style.BLUE, "-"),
        ("dissipated", e["dissipated"], style.VERMILION, "-"),
        ("kinetic, mean", _mean_over(e["kinetic"], window), style.SKY, "-"),
        ("springs, mean", _mean_over(e["spring"], window), style.GREEN, (0, (3, 1.5))),
        ("contacts", e["contact"], style.PURPLE, "-"),
    )
    for label, values, colour, dashes in curves:
        upper.plot(time, values * scale, color=colour, ls=dashes, label=label, lw=0.9)
    upper.set(ylabel=f"Energy ({prefix}J)", ylim=(-0.03 * work * scale, 1.4 * work * scale))
    upper.legend(loc="upper center", ncol=2, columnspacing=1.2, labelspacing=0.25)

    residual = np.abs(e["work"] - e["dissipated"] - stored) / work
    lower.semilogy(time, np.maximum(residual, 1e-18), color=style.BLACK, lw=0.5)
    lower.axhline(PROMISE, color=style.VERMILION, lw=0.7, ls=(0, (4, 2)))
    lower.annotate(f"limit {PROMISE:.0e}".replace("e-0", "e-"), (0.99, PROMISE), (0, 1.5), ha="right", va="bottom",
                   xycoords=("axes fraction", "data"), textcoords="offset points", fontsize=6.5,
                   color=style.VERMILION)  # fmt: skip
    lower.set(xlabel="Time (s)", ylabel="|Residual| / work", xlim=time[[0, -1]])
    lower.set_ylim(1e-15, max(1e-6, 10 * residual.max()))
    return figure


def _scaled(value: float) -> tuple[str, float]:
    """SI prefix and factor that bring ``value`` to between 1 and 1000."""
    for prefix, scale in (("", 1.0), ("m", 1e3), ("µ", 1e6), ("n", 1e9), ("p", 1e12)):
        if value * scale >= 1:
            return prefix, scale
    return "p", 1e12


def _mean_over(values: np.ndarray, samples: int) -> np.ndarray:
    """Running mean over ``samples``, over fewer at the ends."""
    window = np.ones(min(samples, len(values)))
    return np.convolve(values, window, "same") / np.convolve(np.ones(len(values)), window, "same")
