"""Pictures of an impact oscillator: stiff stops against one that does not yield, and a mass that sticks to its stop."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from xarray import Dataset

from vipetsc import register
from vipetsc.figures import style
from vipetsc.io.read import open_run

__version__ = "1.0"
LOOKS = {"bilinear": (style.BLUE, "o"), "hertz": (style.VERMILION, "s")}


@register.figure("rigid_limit", source="sweep")
def rigid_limit(ensemble: Dataset) -> Figure:
    """Draw the largest difference in displacement of each member from ``rigid``, the run next to the sweep."""
    folder = Path(ensemble.attrs["folder"])
    exact = open_run(folder.parent / "rigid/run.h5")["displacement"].values
    figure = style.new_figure(style.COLUMN, 3.0)
    axes = figure.subplots()
    for law, (colour, marker) in LOOKS.items():
        durations = []
        differences = []
        for member in ensemble["member"].sel(law=law).values.ravel():
            run = open_run(folder / str(member) / "run.h5")
            durations.append(np.mean(run["impacts/separation"].values - run["impacts/onset"].values))
            differences.append(np.abs(run["displacement"].values - exact).max())
        axes.loglog(durations, differences, color=colour, marker=marker, linestyle="none", label=law)

    ends = np.array(axes.get_xlim())
    axes.loglog(ends, ends * differences[-1] / durations[-1], color=style.GREY, zorder=0, label="first power")
    axes.set(xlabel="Mean duration of a contact (s)", ylabel="Largest difference (m)")
    axes.legend()
    return figure


@register.figure("reaction")
def reaction(run: Dataset, analysis: Dataset | None) -> Figure:
    """Draw displacement of the mass and the reaction of its stop over the last 25 s."""
    run = run.sel(time=slice(float(run["time"][-1]) - 25.0, None))
    figure = style.new_figure(style.COLUMN, 3.4)
    upper, lower = figure.subplots(2, sharex=True)
    upper.plot(run["time"], run["displacement"].values.ravel(), color=style.BLUE)
    lower.plot(run["time"], run["sites/force"].values.ravel(), color=style.VERMILION)
    upper.set(ylabel="Displacement (m)")
    lower.set(xlabel="Time (s)", ylabel="Reaction (N)")
    return figure
