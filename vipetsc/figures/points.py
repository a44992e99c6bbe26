"""Pictures of named points: history, spectrum and spectrogram, of several runs, with measured records over them."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.case.identify import MeasuredError, RecordTable, read_measured
from vipetsc.figures import panels, style
from vipetsc.figures.page import Page, legend_entries
from vipetsc.figures.style import NoPicture, Shown
from vipetsc.io.tables import ColumnError, column_names, is_hdf5
from vipetsc.spectra.fourier import amplitude_spectrum, spectrogram
from vipetsc.spectra.measures import MOTIONS

MOST_POINTS = 8  # on a page; a note says that there are more
SLOW = 1e3  # rad/s: frequencies up to it are in rad/s, others in krad/s
DECADES = 4  # of amplitudes in a spectrum, below its largest


class PointRecord(NamedTuple):
    """A record over a run: ``values`` (sample,) of the ``point`` at ``time`` (sample,) in s, ``name`` in the legend."""

    name: str
    point: str
    time: np.ndarray
    values: np.ndarray


class PointCurve(NamedTuple):
    """A curve of a panel: even ``time`` (sample,) in s, ``values`` (sample,), its look."""

    time: np.ndarray
    values: np.ndarray
    look: dict[str, Any]


def points(runs: Sequence[Shown], records: Sequence[str] = (), quantity: str = "velocity") -> Figure:
    """Draw a ``quantity`` of each named point: its history, its spectrum, and of a single run its spectrogram.

    Several ``runs`` share the panels. ``records`` are texts FILE or FILE:COLUMN=POINT, as ``read_records`` takes them.
    """
    variable = f"points/{quantity}"
    named = [(shown.name, shown.results[0]) for shown in runs]
    if not all(variable in run for _, run in named):
        raise NoPicture("needs named points, which the case has not ([output] points)")

    first = named[0][1]
    names = [str(name) for name in first["point"].values]
    for name, run in named[1:]:
        if missing := set(names) - {str(point) for point in run["point"].values}:
            raise NoPicture(f"{name} has no point {', '.join(sorted(missing))}, as the first run has")
    measured = [record for text in records for record in read_records(text, names, quantity)]

    shown_names = names[:MOST_POINTS]
    has_map = len(named) == 1
    height = 1.7 * len(shown_names) + 0.4 * bool(records or len(named) > 1)
    page = Page.of(len(shown_names), 2 + has_map, height=height, width_ratios=(3, 2, 3)[: 2 + has_map])
    unit = _frequency_unit(first["time"].values)
    for row, point in zip(page.grid, shown_names, strict=True):
        lines = _lines(named, measured, point, variable)
        _draw_history(row[0], lines, f"{point}: {quantity} ({panels.MOTION_UNITS[quantity]})")
        _draw_spectrum(row[1], lines, f"Amplitude ({panels.MOTION_UNITS[quantity]})", unit)
        if has_map:
            _draw_spectrogram(row[2], lines[0], f"Amplitude ({panels.MOTION_UNITS[quantity]})", unit)
    for axes, title in zip(page.panels, ("History", "Spectrum", "Spectrogram")[: 2 + has_map], strict=False):
        axes.set_title(title)
    # A record may be of one point alone.
    entries = legend_entries(page.grid[:, 0])
    if len(entries) > 1:
        # The spectrum leaves more room than the history.
        page.panels[1].legend(entries.values(), entries.keys(), loc="best")
    if len(names) > MOST_POINTS:
        style.add_note(page.figure, f"the first {MOST_POINTS} of {len(names)} points; the files have all")
    return page.lettered()


# One figure for each quantity; that of the velocity has the plain name.
FIGURES: dict[str, Callable[..., Figure]] = {
    "points": points,
    "points_displacement": partial(points, quantity="displacement"),
    "points_acceleration": partial(points, quantity="acceleration"),
}


def _lines(
    runs: Sequence[tuple[str, xr.Dataset]], records: Sequence[PointRecord], point: str, variable: str
) -> list[PointCurve]:
    """Return the curves of a ``point`` of the ``runs``, then of the ``records``, which lie over them."""
    lines = []
    for number, (name, run) in enumerate(runs):
        # Thinner from run to run: curves that coincide are then seen under one another.
        width = 0.6 + 1.4 * (len(runs) - 1 - number) / max(len(runs), 2)
        look = {"color": style.band_colour(number + 1), "lw": width, "label": name or "run"}
        values = run[variable].sel(point=point).values
        lines.append(PointCurve(run["time"].values, values, look))
    for record in records:
        if record.point == point:
            look = {"color": style.BLACK, "lw": 0.6, "ls": style.DASHED, "label": record.name}
            lines.append(PointCurve(record.time, record.values, look))
    return lines


def _frequency_unit(time: np.ndarray) -> tuple[float, str]:
    """Return the unit in rad/s, and the label, of frequencies up to what samples at ``time`` (sample,) resolve."""
    if np.pi / (time[1] - time[0]) < SLOW:
        return 1.0, "Frequency ω (rad/s)"
    return 1e3, panels.OMEGA


def _draw_history(axes: Axes, lines: Sequence[PointCurve], label: str) -> None:
    """Draw ``lines`` over time, as long as the run lasts."""
    for line in lines:
        axes.plot(line.time, line.values, **line.look, rasterized=True)
    axes.set(xlabel="Time (s)", ylabel=label, xlim=lines[0].time[[0, -1]])


def _draw_spectrum(axes: Axes, lines: Sequence[PointCurve], label: str, unit: tuple[float, str]) -> None:
    """Draw the amplitudes of ``lines`` over the frequency in ``unit``, up to where the first one's leave the scale."""
    top = 0.0
    for line in lines:
        frequency, amplitude = amplitude_spectrum(line.values, line.time[1] - line.time[0])
        axes.semilogy(frequency[1:] / unit[0], np.maximum(amplitude[1:], 1e-300), **line.look)
        top = max(top, float(amplitude.max()))
    top = top or 1.0
    frequency, amplitude = amplitude_spectrum(lines[0].values, lines[0].time[1] - lines[0].time[0])
    seen = np.flatnonzero(amplitude > top * 10.0**-DECADES)
    last = frequency[seen[-1]] if seen.size else frequency[-1]
    axes.set(xlabel=unit[1], ylabel=label, ylim=(top * 10.0**-DECADES, 2 * top))
    axes.set_xlim(0, min(1.1 * last, frequency[-1]) / unit[0])


def _draw_spectrogram(axes: Axes, line: PointCurve, label: str, unit: tuple[float, str]) -> None:
    """Draw a map of amplitudes over time and frequency in ``unit``."""
    time, frequency, amplitude = spectrogram(line.values, line.time[1] - line.time[0])
    norm = panels.log_norm(amplitude, decades=DECADES)
    image = panels.draw_map(axes, line.time[0] + time, frequency / unit[0], amplitude.T, norm)
    seen = np.flatnonzero(amplitude.max(axis=0) > norm.vmin)
    top = frequency[seen[-1]] if seen.size else frequency[-1]
    axes.set(xlabel="Time (s)", ylabel=unit[1], ylim=(0, min(1.1 * top, frequency[-1]) / unit[0]))
    panels.colour_bar(image, axes, label)


def read_records(text: str, names: Sequence[str], quantity: str) -> list[PointRecord]:
    """Return the records in a file over points ``names``; ``text`` is FILE or FILE:COLUMN=POINT.

    Of FILE the columns are taken whose names begin with that of a point, as in the tables of ``export``: a word about
    the quantity and a unit in brackets may follow. COLUMN is a name or a number from 1. The first column is the time in
    s; values are in SI units. Files are those that ``identify`` reads: an HDF5 file has datasets for columns, and the
    times in the one called ``time``. Raises NoPicture for a file that cannot be used.
    """
    file, _, choice = text.partition(":")
    wanted: list[tuple[int | str, str]] = []
    if choice:
        column, _, point = choice.rpartition("=")
        if not column or point not in names:
            raise NoPicture(f"--record {text}: write FILE:COLUMN=POINT; points are {', '.join(names)}")
        wanted.append((int(column) if column.isdigit() else column, point))
    else:
        try:
            heads = column_names(Path(file))
        except ColumnError as error:
            raise NoPicture(f"--record {file}: {error}") from None
        for number, head in enumerate(heads, 1):
            word, _, what = head.partition(" ")
            if word in names and (quantity in what or not any(other in what for other in MOTIONS)):
                wanted.append((head if is_hdf5(Path(file)) else number, word))
        if not wanted:
            remedy = f"no column is named after a point ({', '.join(names)}); write FILE:COLUMN=POINT"
            raise NoPicture(f"--record {file}: {remedy}")

    time: int | str = 1
    if is_hdf5(Path(file)):
        time = "time"
    sensors = [{"quantity": quantity, "cell": 1, "column": column} for column, _ in wanted]
    try:
        read = read_measured(RecordTable.model_validate({"file": file, "time": time, "sensors": sensors}))
    except MeasuredError as error:
        raise NoPicture(f"--record {file}: {error.key}: {error.remedy}") from None
    stem = Path(file).name
    return [
        PointRecord(stem, point, read.times, values) for (_, point), values in zip(wanted, read.values.T, strict=True)
    ]
