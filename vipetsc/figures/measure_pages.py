"""Pages of a sweep's measures over whatever keys it sweeps: curves over one number, maps over two, panels for more.

A measure is any variable of ``ensemble.h5`` over all axes of its sweep, perhaps over parts of the frequency axis (pass
bands and gaps) too. Keys with numbers are the axes of panels; keys with words or lists, or with two numbers, are
curves, panels or pages (see ``Roles``). Samples of disorder become a mean and a band.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.figures.measure_panels import (
    CommonAxes,
    Curve,
    LargestOnMap,
    MeasurePage,
    draw_curves,
    draw_maps,
    draw_samples,
)
from vipetsc.figures.style import Drawing
from vipetsc.figures.sweep_members import in_file_name, table
from vipetsc.figures.swept_axes import SweptAxis, SweptKey
from vipetsc.io.read import axes as axes_of
from vipetsc.io.read import over_samples
from vipetsc.wording import capitalised, with_unit

MOST_PAGES = 12  # of a measure, as many as a reader turns over; of more only the one with the largest value is drawn
BAND = "band"  # the first word in the names of those parts of the frequency axis that are pass bands
LONGEST_STEM = 150  # letters of a file's name: file systems take 255, and a report puts something before it

# Variables of an ensemble that are no measures.
ABOUT_MEMBERS = {"status", "number"}
# Measures that are drawn only if they are asked for by name, because few readers look at them.
ON_REQUEST = {
    "ledger_error",
    "work",
    "ibtet_whole",
    "entropy/masked",
    "entropy/joint",
    "entropy/error",
    "entropy/start",
    "bands/modal_energy",
    "rms_displacement",
    "rms_velocity",
    "rms_acceleration",
    "steady_drift",
    "lyapunov_error",
}
MOST_CURVES = 6  # of a panel: as many as there are markers
MOST_PANELS = 16  # of a page: four by four are an inch and a half wide each
LEAST_ON_A_MAP = 3  # values of a key that is an axis of a map; two values are better compared as curves
PART = "part"  # the dimension of parts of the frequency axis


class Roles(NamedTuple):
    """Roles of the axes of a measure: ``x`` (and ``y`` of a map) become axes of the panels, the others are compared.

    Each combination of the values of ``curves`` is a curve in a panel, of ``panels`` a panel, and of ``pages`` a page.
    """

    x: SweptAxis
    y: SweptAxis | None
    curves: tuple[SweptAxis, ...]
    panels: tuple[SweptAxis, ...]
    pages: tuple[SweptAxis, ...]

    @property
    def labels(self) -> list[str]:
        """The labels of the axes of numbers: pages with the same ones can have common axes."""
        labels = []
        for axis in (self.x, self.y):
            if axis is not None and axis.is_number:
                labels.append(axis.label)
            elif axis is not None:
                labels.append("")
        return labels

    @classmethod
    def of(cls, axes: Sequence[SweptAxis]) -> Self:
        """Return the roles of ``axes``, of which there is at least one; ``y`` is None for curves.

        The longest axis with numbers, or of all axes if none has, is ``x``; the next one with numbers is ``y`` if both
        have ``LEAST_ON_A_MAP`` values. The last of the other axes become curves, unless there is a map, those before
        them panels, and the first ones pages.
        """
        # Axes of equal length stay in the order of the case: the sort is stable.
        longest_first = sorted(axes, key=lambda axis: -axis.size)
        numbers = [axis for axis in longest_first if axis.is_number]
        map_axes = [axis for axis in numbers if axis.size >= LEAST_ON_A_MAP]
        x = (numbers or longest_first)[0]
        y = None
        taken = {x.dimension}
        if len(map_axes) > 1:
            y = map_axes[1]
            taken.add(y.dimension)

        # The last axes of a case vary fastest: what they compare stands closest together. Pass bands are no curves if
        # there is anything else to compare: they differ by orders of magnitude, and members are compared band by band.
        others = [axis for axis in axes if axis.dimension not in taken]
        keys = [axis for axis in others if axis.dimension != PART]
        curves: tuple[SweptAxis, ...] = ()
        if y is None:
            curves = _last_of(keys or others, MOST_CURVES)
        taken |= {axis.dimension for axis in curves}

        others = [axis for axis in others if axis.dimension not in taken]
        panels = _last_of(others, MOST_PANELS)
        pages = tuple(others[: len(others) - len(panels)])
        return cls(x=x, y=y, curves=curves, panels=panels, pages=pages)


def _last_of(axes: Sequence[SweptAxis], most: int) -> tuple[SweptAxis, ...]:
    """Return as many of the last ``axes`` as together have at most ``most`` combinations of values."""
    count = 0
    while count < len(axes) and math.prod(axis.size for axis in axes[-count - 1 :]) <= most:
        count += 1
    return tuple(axes[len(axes) - count :])


class Measure(NamedTuple):
    """A measure of a sweep over the dimensions of ``axes``.

    ``values`` are the measure, NaN where it is not finite. Where the sweep has ``samples`` samples of disorder, these
    are means over the ``counted`` samples that have a value, and ``band`` are the lowest and the highest quantile over
    them; without samples both are None. ``failed`` is the number of failed members at each place of the axes, one for
    each sample. ``text`` says what the measure is.
    """

    name: str
    unit: str
    text: str
    values: xr.DataArray
    band: tuple[xr.DataArray, xr.DataArray] | None
    samples: int
    counted: xr.DataArray | None
    axes: tuple[SweptAxis, ...]
    failed: xr.DataArray

    @classmethod
    def of(cls, ensemble: xr.Dataset, name: str) -> Self:
        """Return the measure ``name`` of an ensemble, means over its samples if it has any."""
        means = over_samples(ensemble)
        values = means[name]
        seeds = _seeds(ensemble)
        failed = ensemble["contact_episodes"].isnull()
        counted = None
        if seeds.size:
            failed = failed.sum(_seed_dimension(ensemble))
            counted = means.get(f"statistics/{name}/samples", means["statistics/samples"])

        ends = []
        if f"statistics/{name}/quantiles" in means:
            quantiles = means[f"statistics/{name}/quantiles"]
            ends = [quantiles.isel(quantile=0), quantiles.isel(quantile=-1)]

        axes = SweptAxis.all_of(means)
        place: dict[str, Any] = {}
        if PART in values.dims:
            # Gaps and what lies above the bands are left out: a transfer is one between pass bands.
            numbers, bands = _bands_of(values)
            place[PART] = numbers
            axes += [bands]
        # Axes of one value have no part in a picture.
        axes = [axis for axis in axes if axis.size > 1]
        shown = {axis.dimension for axis in axes}
        first = {str(dimension): 0 for dimension in values.dims if dimension not in shown}
        values, *ends = (item.isel(place).isel(first) for item in (values, *ends))
        if counted is not None:
            counted = counted.isel({**place, **first}, missing_dims="ignore")

        # Files have the unit "1" where texts have none.
        unit = str(values.attrs.get("units", "1"))
        if unit == "1":
            unit = ""
        band = None
        if ends:
            band = (ends[0], ends[1])
        return cls(
            name=name,
            unit=unit,
            text=str(values.attrs.get("long_name", "")),
            values=values.where(np.isfinite),
            band=band,
            samples=seeds.size,
            counted=counted,
            axes=tuple(axes),
            failed=failed.isel(first, missing_dims="ignore"),
        )

    @property
    def label(self) -> str:
        """What the measure is, with its unit."""
        return with_unit(capitalised(self.text or self.name), self.unit)

    @property
    def drawn(self) -> np.ndarray:
        """All that curves show (number,): the values, and the ends of the band."""
        return np.concatenate([part.values.ravel() for part in (self.values, *(self.band or ()))])

    def at(self, place: Mapping[str, int]) -> Self:
        """Return the measure at the indices ``place`` of its dimensions, without these."""
        counted = self.counted
        if counted is not None:
            counted = counted.isel(place, missing_dims="ignore")
        return self._replace(
            values=self.values.isel(place),
            band=self.band and (self.band[0].isel(place), self.band[1].isel(place)),
            axes=tuple(axis for axis in self.axes if axis.dimension not in place),
            counted=counted,
            failed=self.failed.isel(place, missing_dims="ignore"),
        )

    @property
    def failures(self) -> str:
        """A sentence on the members that failed; empty if none did."""
        failed = int(self.failed.sum())
        if not failed:
            return ""
        return f"{failed} of {self.failed.size * max(self.samples, 1)} members failed and are left out"

    @property
    def sample_text(self) -> str:
        """How many samples the values are means over: "8 samples", "6 of 8 samples", "5 to 8 of 8 samples"."""
        assert self.counted is not None
        least = int(self.counted.min())
        most = int(self.counted.max())
        if least == self.samples:
            return f"{self.samples} samples"
        if least == most:
            return f"{least} of {self.samples} samples"
        return f"{least} to {most} of {self.samples} samples"

    def largest(self) -> dict[str, int]:
        """Return the place of the largest value: its index along every dimension."""
        index = np.unravel_index(int(np.nanargmax(self.values.values)), self.values.shape)
        return {str(dimension): int(i) for dimension, i in zip(self.values.dims, index, strict=True)}

    def place_text(self, place: Mapping[str, int]) -> str:
        """Return what the keys are at the indices ``place``."""
        return ", ".join(axis.texts[place[axis.dimension]] for axis in self.axes if axis.dimension in place)


def _bands_of(values: xr.DataArray) -> tuple[list[int], SweptAxis]:
    """Return the indices of the pass bands among the parts of the frequency axis, and the axis of the bands alone."""
    parts = [str(part) for part in np.atleast_1d(values.attrs["parts"])]
    indices = [index for index, part in enumerate(parts) if part.startswith(BAND)]
    numbers = np.array([parts[index].removeprefix(f"{BAND} ") for index in indices], dtype=object)
    return indices, SweptAxis(dimension=PART, keys=(SweptKey(path=BAND, unit="", values=numbers),))


def _seeds(ensemble: xr.Dataset) -> np.ndarray:
    """Return the seeds of the samples over which an ensemble has statistics; empty where it has none."""
    if "statistics/samples" not in ensemble:
        return np.array([])
    return np.asarray(ensemble[_seed_dimension(ensemble)].values)


def _seed_dimension(ensemble: xr.Dataset) -> str:
    return next(dim for dim in axes_of(ensemble) if ensemble[dim].attrs["long_name"] == "disorder.seed")


def is_on_request(name: str) -> bool:
    """Return whether the measure ``name``, perhaps of a point, has pages only where it is asked for."""
    return name in ON_REQUEST or name.partition("/")[0] in ON_REQUEST


def figure_name(measure: str) -> str:
    """Return the name by which the pages of a ``measure`` are asked for, with which their files begin."""
    return measure.replace("/", "_")


def measures_of(ensemble: xr.Dataset) -> list[str]:
    """Return the names of the measures that an ensemble holds."""
    over_all = set(axes_of(ensemble))
    names = []
    for name, variable in ensemble.data_vars.items():
        dims = set(map(str, variable.dims))
        is_measure = (
            not str(name).startswith(("statistics/", "fits/", "normalised_fits/")) and name not in ABOUT_MEMBERS
        )
        if is_measure and dims - {PART} == over_all and np.issubdtype(variable.dtype, np.number):
            names.append(str(name))
    return names


def reason_without_page(ensemble: xr.Dataset, name: str, by_name: bool) -> str:
    """Return the reason why the measure ``name`` of an ensemble has no page; empty if it has one.

    One that vanishes everywhere has a page only where it is asked for ``by_name``.
    """
    values = ensemble[name].values
    if not np.isfinite(values).any():
        return "no member has a value"
    if PART in ensemble[name].dims and not _bands_of(ensemble[name])[0]:
        return "the cell has no pass band"
    if not by_name and not np.nan_to_num(values).any():
        return "0 for every member"
    if not SweptAxis.all_of(over_samples(ensemble)) and _seeds(ensemble).size < 2:
        return "the sweep has one member, so that no key varies; `run CASE --member 0` draws its pictures"
    return ""


def measure_pages(
    ensemble: xr.Dataset, name: str, sweep: str = "", others: Sequence[xr.Dataset] = ()
) -> Iterator[Drawing]:
    """Offer the pages of the measure ``name``; ``sweep`` names it where pictures of several lie in one folder.

    Pages over the same keys as those of the ``others`` have common axes with them.
    """
    measure = Measure.of(ensemble, name)
    keys = [key.path for axis in measure.axes for key in axis.keys]
    heading = f"{table(ensemble)['name']}: {measure.text or name}"

    begin = "-".join(filter(None, [figure_name(name), sweep, "over"]))
    if set(keys) <= {BAND}:
        stem = in_file_name("-".join([begin, "disorder.seed", *keys]))
        yield Drawing(stem, partial(_samples_page, ensemble, measure, heading))
        return
    stem = in_file_name("-".join([begin, *keys]))[:LONGEST_STEM]
    yield from _pages_over_keys(measure, heading, stem, [Measure.of(other, name) for other in others])


def _common_axes(measure: Measure, others: Sequence[Measure]) -> CommonAxes | None:
    """Return what the pages of a measure have in common with those of ``others`` over the same keys.

    None if no other one is over the same keys.
    """
    roles = Roles.of(measure.axes)
    together = [measure]
    for other in others:
        if other.axes and Roles.of(other.axes).labels == roles.labels:
            together.append(other)
    if len(together) == 1:
        return None
    places = [Roles.of(one.axes) for one in together]
    return CommonAxes(
        values=np.concatenate([one.drawn for one in together]),
        x=np.concatenate([place.x.positions for place in places]),
        y=np.concatenate([place.y.positions for place in places if place.y] or [np.zeros(1)]),
    )


def _pages_over_keys(measure: Measure, heading: str, stem: str, others: Sequence[Measure]) -> Iterator[Drawing]:
    """Offer a page, or one at each value of the keys for which a page has no room."""
    roles = Roles.of(measure.axes)
    common = _common_axes(measure, others)
    dimensions = [axis.dimension for axis in roles.pages]
    places = [dict(zip(dimensions, index, strict=True)) for index in product(*(range(a.size) for a in roles.pages))]
    cut = ""
    if len(places) > MOST_PAGES:
        best = measure.largest()
        # One page rather than none: the largest value is what a search over so many keys is for.
        places = [{dimension: best[dimension] for dimension in dimensions}]
        cut = "through the largest value: "

    for number, place in enumerate(places, 1):
        page = measure.at(place)
        if np.isfinite(page.values).any():
            page_stem = stem
            if dimensions:
                page_stem += f"-{number}"
            yield Drawing(page_stem, partial(_page, page, roles, [heading, cut + measure.place_text(place)], common))


def _samples_page(ensemble: xr.Dataset, measure: Measure, heading: str) -> Figure:
    """Draw a measure of every sample over its seed, for each pass band if it has parts."""
    dimension = _seed_dimension(ensemble)
    values = ensemble[measure.name].isel({other: 0 for other in axes_of(ensemble) if other != dimension})
    names = [""]
    colours = [""]
    if PART in values.dims:
        indices, bands = _bands_of(values)
        values = values.isel(part=indices)
        names = [f"{text}: " for text in bands.texts]
        colours = _band_colours(bands)
    series = np.atleast_2d(values.transpose(..., dimension).values)

    labels = []
    for name, samples in zip(names, series, strict=True):
        # The quantiles of the band that curves over keys have.
        low, high = np.nanquantile(samples, (0.05, 0.95))
        labels.append(f"{name}mean {np.nanmean(samples):.4g}, 5 to 95 % of samples: {low:.4g} to {high:.4g}")
    lines = filter(None, [heading, f"of {measure.sample_text}", measure.failures])
    page = MeasurePage.of(measure.label, list(lines), [""], labels)
    drawn = []
    for number, (samples, colour) in enumerate(zip(series, colours, strict=True)):
        curve = Curve(label=f"samples {number}", number=number, values=samples, band=None, colour=colour)
        drawn.append(curve)
    figure = draw_samples(page, _seeds(ensemble), drawn)
    page.write_legend()
    return figure


def _page(measure: Measure, roles: Roles, title: Sequence[str], common: CommonAxes | None) -> Figure:
    """Draw a measure in the panels of a page, its largest value marked, on axes ``common`` to several pages."""
    best = measure.largest()
    # If bands are compared, the largest value is in the driven one, and to mark it says nothing.
    marks_largest = all(axis.dimension != PART for axis in measure.axes)
    lines = _lines_of(measure, roles, title)
    if marks_largest:
        largest = f"{float(measure.values.isel(best)):.4g} {measure.unit}".strip()
        lines.insert(1, f"largest (ring): {largest} at {measure.place_text(best)}")

    panels = _by_place(measure, roles.panels)
    legend: list[str] = []
    if roles.curves:
        legend = list(_by_place(measure, roles.curves))
    columns = 0
    if len(roles.panels) > 1:
        columns = roles.panels[-1].size
    page = MeasurePage.of(measure.label, lines, list(panels), legend, columns)

    marked = None
    if marks_largest:
        marked = measure.place_text({axis.dimension: best[axis.dimension] for axis in roles.panels})
    if roles.y:
        fields = [panel.values.transpose(roles.y.dimension, roles.x.dimension).values for panel in panels.values()]
        ring = None
        if marked is not None:
            ring = LargestOnMap(x=best[roles.x.dimension], y=best[roles.y.dimension], panel=list(panels).index(marked))
        return draw_maps(page, roles.x, roles.y, fields, ring, common)

    for axes, (text, panel) in zip(page.page.panels, panels.items(), strict=True):
        largest_point = None
        if text == marked:
            largest_point = (best[roles.x.dimension], float(measure.values.isel(best)))
        draw_curves(axes, roles.x, _curves(panel, roles.curves), largest_point)
    return page.finish_curves(roles.x, measure.drawn, common)


def _lines_of(measure: Measure, roles: Roles, title: Sequence[str]) -> list[str]:
    """Return the lines of a page: the ``title``, and what values are left out."""
    lines = [*title]
    if measure.samples:
        means = f"means over {measure.sample_text}"
        if roles.y is None:
            means += "; bands: 5 to 95 % of the samples"
        lines.append(means)
    if measure.failures:
        lines.append(measure.failures)
    all_failed = measure.failed == max(measure.samples, 1)
    without_value = int((measure.values.isnull() & ~all_failed).sum())
    if without_value:
        lines.append(f"{without_value} of {measure.values.size} values are missing")
    return lines


def _by_place(measure: Measure, axes: Sequence[SweptAxis]) -> dict[str, Measure]:
    """Return the measure at every combination of the values of ``axes``, by the text of the combination."""
    indices = product(*(range(axis.size) for axis in axes))
    places = [dict(zip((axis.dimension for axis in axes), index, strict=True)) for index in indices]
    return {measure.place_text(place): measure.at(place) for place in places}


def _curves(panel: Measure, compared: Sequence[SweptAxis]) -> list[Curve]:
    """Return the curves of a panel, one for each combination of what is ``compared`` in it."""
    are_bands = [axis.dimension for axis in compared] == [PART]
    colours = [""] * MOST_CURVES
    if are_bands:
        colours = _band_colours(compared[0])
    curves = []
    for number, (label, one) in enumerate(_by_place(panel, compared).items()):
        ends = one.band and (one.band[0].values, one.band[1].values)
        curve = Curve(label=label, number=number, values=one.values.values, band=ends, colour=colours[number])
        curves.append(curve)
    return curves


def _band_colours(bands: SweptAxis) -> list[str]:
    """Return the colour of each pass band along an axis of them."""
    numbers = [style.band_number(text) for text in bands.texts]
    return [style.band_colour(number) if number else "" for number in numbers]
