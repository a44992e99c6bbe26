"""An identification: record and model, residuals, profiles of the misfit, correlation, and the course of the fit."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vipetsc.case.identify import IdentifyCase
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page
from vipetsc.figures.series import Series
from vipetsc.figures.style import NoPicture

MOST_CHANNELS = 8  # on a page, which is 15 inches high then; a note says that there are more
MOST_NAMES = 12  # parameters that are named in a legend, and whose correlations are written out: more would overlap
# Largest lag, in samples, to which the correlation of residuals is drawn: a few periods of a record, in which physics
# that the model neglects shows.
MOST_LAGS = 40
# The error above which a parameter counts as not determined, as `vipetsc.identification.uncertainty.DETERMINED`, which
# figures may not import. It is a factor of 1.6 of a positive parameter, half the range of others.
DETERMINED = 0.5
LARGEST_ERROR = 1e6  # drawn for a direction in the parameters' space that the record says nothing about


def record_and_model(identified: xr.Dataset) -> Figure:
    """Draw every channel: measured values with the model over them, and next to these the residuals.

    Grey is one standard deviation of the noise; p is the probability that white noise is that much correlated.
    """
    count = min(identified.sizes["channel"], MOST_CHANNELS)
    page = Page.of(count, 2, height=1.9 * count, width_ratios=(3, 2))
    for number, (motion, residual) in enumerate(page.grid):
        channel = identified.isel(channel=number)
        chosen = identified["data/channel"].values == number
        time = 1e3 * identified["data/time"].values[chosen]
        measured = identified["data/measured"].values[chosen]
        model = identified["data/model"].values[chosen]

        unit = channel["channels/unit"].item()
        motion.plot(time, measured, ".", ms=2.5, label="measured", **style.CURVES["measured"])
        motion.plot(time, model, lw=0.8, label="model", **style.CURVES["model"])
        motion.set(xlabel="Time (ms)", ylabel=f"({unit})", title=str(channel["channel"].values))

        noise = float(channel["channels/noise"])
        residual.axhspan(-noise, noise, color=style.PALE, lw=0)
        residual.plot(time, measured - model, ".", ms=2, **style.CURVES["residual"])
        probability = float(channel["channels/probability"])
        residual.set(xlabel="Time (ms)", ylabel=f"({unit})", title=f"Measured - model; white: p = {probability:.2g}")
    page.panels[0].legend(loc="best", fontsize=6)
    _note_channels(page.figure, identified)
    return page.lettered()


def _note_channels(figure: Figure, identified: xr.Dataset) -> None:
    """Say below a ``figure`` how many channels it leaves out."""
    count = identified.sizes["channel"]
    if count > MOST_CHANNELS:
        style.add_note(figure, f"the first {MOST_CHANNELS} of {count} channels; the file has all")


def residual_correlations(identified: xr.Dataset) -> Figure:
    """Draw the autocorrelation of every channel's residuals with the bounds of white noise."""
    count = min(identified.sizes["channel"], MOST_CHANNELS)
    page = Page.of(columns=count, width=style.PAGE, height=2.4, sharey=True)
    for number, panel in enumerate(page.panels):
        chosen = identified["data/channel"].values == number
        residuals = identified["data/measured"].values[chosen] - identified["data/model"].values[chosen]
        # Without their mean, which would make the values at all lags alike and hide what varies.
        residuals = residuals - residuals.mean()
        lags = np.arange(1, min(MOST_LAGS, len(residuals) // 2) + 1)
        values = np.array([residuals[lag:] @ residuals[:-lag] for lag in lags])
        power = residuals @ residuals
        if power:
            values = values / power

        # Of white noise 95 % of the values lie between these bounds.
        bound = 1.96 / np.sqrt(len(residuals))
        panel.axhspan(-bound, bound, color=style.PALE, lw=0)
        panel.vlines(lags, 0, values, color=style.BLUE, lw=0.8)
        panel.set(xlabel="lag (samples)", title=str(identified["channel"].values[number]))

    page.panels[0].set_ylabel("autocorrelation of residuals")
    _note_channels(page.figure, identified)
    return page.lettered()


def misfit_profiles(identified: xr.Dataset) -> Figure:
    """Draw how the misfit grows when each parameter is held at values off the best one, and all others are fitted.

    Dashed is the parabola ((value - best) / standard error)^2 of a model that is linear in its parameters.
    """
    if not identified.sizes["place"]:
        raise NoPicture("no profile was computed ([identify] profile = 0)")

    count = identified.sizes["parameter"]
    columns = min(count, 4)
    rows = -(-count // columns)
    page = Page.of(rows, columns, width=style.PAGE, height=1.7 * rows + 0.4, count=count)
    for number, axes in enumerate(page.panels):
        _draw_profile(axes, identified.isel(parameter=number))
    return page.lettered()


def _draw_profile(axes: Axes, parameter: xr.Dataset) -> None:
    """Draw the profile of one ``parameter``, and the parabola of its standard error; see ``misfit_profiles``."""
    axes.set_title(str(parameter["parameter"].values))
    value = float(parameter["value"])
    error = float(parameter["standard_error"])
    unit = parameter["unit"].item()
    # In percent of the best value: the digits in which clearances differ would not fit below an axis. Of a best value
    # of 0 there are no percentages.
    percent = 100 / value if value else 1.0
    places = percent * (parameter["profile/value"].values - value)
    axes.plot(places, parameter["profile/cost"].values, "o-", color=style.BLUE, ms=3, lw=0.8)
    if np.isfinite(error) and error > 0:
        dense = np.linspace(places.min(), places.max(), 100)
        parabola = (dense / (percent * error)) ** 2
        axes.plot(dense, parabola, color=style.GREY, lw=0.7, ls=style.DASHED)
    axes.axvline(0.0, color=style.BLACK, lw=0.6)
    label = f"from {value:.4g}"
    if value:
        label = f"% {label}"
    if unit != "1":
        label += f" {unit}"
    axes.set(xlabel=label, ylabel="misfit - least")


def parameter_correlation(identified: xr.Dataset) -> Figure:
    """Draw the correlation of the parameters' errors, and the error along each direction in their space.

    Directions are the right singular vectors of the Jacobian; the dashed line is at ``DETERMINED``.
    """
    names = identified["parameter"].values
    count = len(names)
    page = Page.of(columns=2, height=3.2)
    matrix, directions = page.panels
    shown = matrix.imshow(identified["correlation"].values, vmin=-1, vmax=1, cmap="RdBu_r")
    size = 6
    if count > MOST_NAMES:
        size = 4
    matrix.set_xticks(np.arange(count), names, rotation=90, fontsize=size)
    matrix.set_yticks(np.arange(count), names, fontsize=size)
    matrix.set_title("Correlation of the errors")
    page.figure.colorbar(shown, ax=matrix, shrink=0.8)
    if count <= MOST_NAMES:
        for row, column in np.ndindex(count, count):
            value = float(identified["correlation"].values[row, column])
            colour = panels.text_colour(shown.to_rgba(value))
            matrix.text(column, row, f"{value:.1f}", ha="center", va="center", fontsize=4.5, color=colour)

    # The error along a direction is 1 over its singular value, which may be 0.
    singular = np.maximum(identified["singular"].values, 1 / LARGEST_ERROR)
    directions.semilogy(identified["direction"].values, 1 / singular, "o", color=style.BLUE, ms=4)
    directions.axhline(DETERMINED, color=style.GREY, lw=0.7, ls=style.DASHED)
    directions.xaxis.set_major_locator(MaxNLocator(integer=True))
    directions.set(xlabel="direction", ylabel="relative error along it", title="Dashed: no longer determined")
    return page.lettered()


def growing_windows(identified: xr.Dataset) -> Figure:
    """Draw the misfit and the parameters over the growing windows of the record, and how well each start ended.

    Parameters are drawn as coordinates, in which the fit takes its steps, from their last values. The deviance of a
    start is minus twice the logarithm of its likelihood, less that of the best; starts that end in one valley have one
    number. A start that failed has neither, and is counted in the title.
    """
    plan = IdentifyCase.of(identified)
    valley = identified["starts/valley"].values
    page = Page.of(columns=2 + (len(valley) > 1), height=2.6)
    misfit, course, *starts = page.panels
    windows = identified["window"].values
    misfit.semilogy(windows, identified["windows/misfit"].values, "o-", color=style.BLUE, ms=3, lw=0.8)
    # Room for these numbers.
    misfit.margins(y=0.15)
    # The number of contact episodes in each window stands at the foot of the panel.
    for number, impacts in zip(windows, identified["windows/impacts"].values, strict=True):
        misfit.annotate(str(impacts), (number, 0.02), xycoords=("data", "axes fraction"), fontsize=5, ha="center")
    misfit.set(xlabel="window (below: contacts)", ylabel="misfit / noise", title="Misfit")
    for panel in (misfit, course):
        # Windows are counted: a tick between two of them would mean nothing.
        _count_along(panel, windows)

    values = identified["windows/value"].values
    for number, parameter in enumerate(plan.parameters):
        last = parameter.to_coordinate(float(identified["value"].values[number]))
        path = [parameter.to_coordinate(value) - last for value in values[:, number]]
        look = {"marker": "o", "ms": 2, "lw": 0.7, **style.numbered_look(number)}
        Series(windows, np.array(path), look, parameter.name).draw(course)
    course.set(xlabel="window", ylabel="distance from the end", title="Coordinates")
    if len(plan.parameters) <= MOST_NAMES:
        course.legend(loc="best", fontsize=5)

    # With one start there is nothing to compare.
    for axes in starts:
        axes.plot(valley, identified["starts/deviance"].values, "o", color=style.VERMILION, ms=3)
        axes.set_yscale("symlog")
        title = f"{len(valley)} starts"
        failed = int((valley == 0).sum())
        if failed:
            title += f", {failed} failed"
        axes.set(xlabel="valley", ylabel="deviance - least", title=title)
        _count_along(axes, valley)
    return page.lettered()


def _count_along(axes: Axes, numbers: np.ndarray) -> None:
    """Give the x axis of ``axes`` ticks at whole numbers alone, also where all ``numbers`` are one."""
    axes.set_xlim(numbers.min() - 0.5, numbers.max() + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


FIGURES = (record_and_model, residual_correlations, misfit_profiles, parameter_correlation, growing_windows)
"""All pictures of an identification, which bear the names of their functions."""
