"""Pages of a sweep's measures name the keys that vary, and draw any number of them; nothing is simulated."""

from itertools import product
from math import prod
from typing import Any

import numpy as np
import pytest
import tomli_w
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tests.readable import complaints
from vipetsc.case import Case
from vipetsc.case.keys import unit_of
from vipetsc.case.sweep import coordinate
from vipetsc.figures.measure_pages import MOST_PAGES, Measure, measure_pages, measures_of, reason_without_page
from vipetsc.figures.measure_panels import cell_edges, log_ticks
from vipetsc.figures.measure_roles import Roles
from vipetsc.figures.style import rc_style, save
from vipetsc.figures.sweep_members import Labels
from vipetsc.figures.swept_axes import SweptAxis, even_scale

# Six values in equal ratios: a curve on a logarithmic axis.
AMPLITUDES = {"drive.amplitude": [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]}
# Two values are too few for an axis, and become curves; three are enough for a map.
RESTITUTIONS = {"contacts.restitution": [0.3, 0.9]}
CLEARANCES = {"contacts.clearance": [2e-4, 5e-4, 1e-3, 2e-3]}
THREE = {"contacts.restitution": [0.3, 0.6, 0.9]}
LAWS = {"contacts.law": ["hertz", "bilinear"]}
SITES = {"contacts.sites": [[9], [9, 20], [4, 30]]}


BLANKS = str.maketrans("\n\u00a0", "  ")  # breaks of lines, and blanks where none may be


@pytest.fixture(autouse=True)
def style():
    with rc_style():
        yield


def ensemble_of(*axes: dict[str, list], drive: dict[str, Any] | None = None, parts: int = 0) -> xr.Dataset:
    """Return an ensemble over ``axes``, dicts of keys with their values, whose measures rise with the member."""
    dims = [next(iter(axis)).rpartition(".")[2] for axis in axes]
    coords = {}
    for dim, axis in zip(dims, axes, strict=True):
        for path, values in axis.items():
            # The dimension has the key's last part as its name, as in ensembles, and its path is an attribute.
            about = {"long_name": path, "units": "1"}
            coords[path.rpartition(".")[2]] = xr.Variable(dim, coordinate(values), about)

    shape = [len(next(iter(axis.values()))) for axis in axes]
    # All members have different values, so that a value drawn at a wrong place is seen.
    number = np.arange(prod(shape)).reshape(shape)
    about = {"units": "1", "long_name": "inter-band energy transfer"}
    data = {
        "status": (dims, np.zeros(shape, np.int8)),
        "member": (dims, np.full(shape, "name", object)),
        "number": (dims, number),
        "contact_episodes": (dims, number.astype(float), {"units": "1", "long_name": "contact episodes"}),
        "ibtet": (dims, 0.01 * (number + 1.0), about),
    }
    # Values fall by decades from part to part, so that a curve's values identify its part.
    if parts:
        fractions = np.stack([10.0**-part * (number + 1.0) for part in range(parts)], axis=-1)
        names = ["below", *(f"band {part}" for part in range(1, parts))]
        data["bands/share"] = ((*dims, "part"), fractions, {"units": "1", "long_name": "fraction", "parts": names})

    case = tomli_w.dumps({"name": "tried", "drive": drive or {}, "sweep": {}})
    return xr.Dataset(data, coords, {"case": case})


def with_samples(*axes: dict[str, list]) -> xr.Dataset:
    """Return an ensemble over eight seeds and ``axes``, with the statistics that a finished sweep has."""
    ensemble = ensemble_of({"disorder.seed": list(range(8))}, *axes)
    return sampled(ensemble)


def sampled(ensemble: xr.Dataset) -> xr.Dataset:
    """Return an ensemble over seeds with its statistics."""
    for name in ("ibtet", "contact_episodes"):
        values = ensemble[name]
        quantiles = values.quantile([0.05, 0.5, 0.95], dim="seed")
        ensemble[f"statistics/{name}/samples"] = values.notnull().sum("seed")
        ensemble[f"statistics/{name}/mean"] = values.mean("seed")
        ensemble[f"statistics/{name}/quantiles"] = quantiles.transpose("quantile", ...).drop_vars("quantile")
    ensemble["statistics/samples"] = ensemble["contact_episodes"].notnull().sum("seed")
    return ensemble


def drawn(ensemble: xr.Dataset, name: str = "ibtet") -> dict[str, Figure]:
    return {drawing.stem: drawing.draw() for drawing in measure_pages(ensemble, name)}


def only(ensemble: xr.Dataset, name: str = "ibtet") -> Figure:
    (figure,) = drawn(ensemble, name).values()
    return figure


def panels(figure: Figure) -> list[Axes]:
    return [axes for axes in figure.get_axes() if axes.axison and axes.get_label() != "<colorbar>"]


def title(figure: Figure) -> str:
    bodies = [figure, *figure.subfigs]
    texts = [body._suptitle.get_text() for body in bodies if body._suptitle]
    # The title is one line; notes are below the picture.
    return " ".join([*texts, figure.get_label()]).translate(BLANKS)


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for body in figure.subfigs for box in body.legends for text in box.get_texts()]


def curves(axes: Axes) -> list:
    return [line for line in axes.lines if not line.get_label().startswith("_")]


def test_two_values_of_a_key_are_two_curves_of_their_own_colour_and_name():
    figure = only(ensemble_of(RESTITUTIONS, AMPLITUDES))
    (axes,) = panels(figure)
    low, high = curves(axes)
    np.testing.assert_allclose(low.get_ydata(), 0.01 * np.arange(1, 7))
    np.testing.assert_allclose(high.get_ydata(), 0.01 * np.arange(7, 13))
    assert to_hex(low.get_color()) != to_hex(high.get_color())
    assert legend(figure) == ["contact restitution 0.3", "contact restitution 0.9"]
    assert "for each contact restitution" in title(figure)
    assert "largest (ring): 0.12 at contact restitution 0.9, drive amplitude 32 N" in title(figure)


def test_the_ring_is_at_the_largest_value():
    ensemble = ensemble_of(RESTITUTIONS, AMPLITUDES)
    # The largest value lies inside a curve: rising values would have the ring at the end.
    ensemble["ibtet"][0, 3] = 5.0
    (axes,) = panels(only(ensemble))
    (ring,) = [line for line in axes.lines if line.get_markerfacecolor() == "none"]
    assert ring.get_xydata().tolist() == [[8.0, 5.0]]


@pytest.mark.parametrize("turned", [False, True])
def test_two_numbers_are_a_map_with_contours_and_its_largest_marked(turned):
    axes_of_sweep = [THREE, CLEARANCES] if turned else [CLEARANCES, THREE]
    ensemble = ensemble_of(*axes_of_sweep)
    figure = only(ensemble)
    (axes,) = panels(figure)
    (mesh,) = [shape for shape in axes.collections if isinstance(shape, QuadMesh)]
    # The key with more values is along x, whichever comes first in the case.
    expected = ensemble["ibtet"].transpose("restitution", "clearance")
    np.testing.assert_allclose(np.reshape(mesh.get_array(), (3, 4)), expected)
    assert len(axes.collections) > 1  # contours
    # The ring is the only line, at the last member, whose value is the largest.
    assert {tuple(line.get_xydata()[0]) for line in axes.lines} == {(2e-3, 0.9)}
    assert [text.get_text() for text in axes.get_xticklabels()] == ["0.0002", "0.0005", "0.001", "0.002"]
    assert ": inter-band energy transfer largest (ring)" in title(figure)


def test_a_map_over_falling_values_shows_each_at_its_place():
    # A mesh needs rising positions: values that fall are turned with their members.
    falling = {"contacts.clearance": CLEARANCES["contacts.clearance"][::-1]}
    (axes,) = panels(only(ensemble_of(falling, THREE)))
    mesh = axes.collections[0]
    assert np.reshape(mesh.get_array(), (3, 4))[0, 0] == pytest.approx(0.01 * 10)


def test_words_and_lists_are_curves_and_panels_with_their_values():
    figure = only(ensemble_of(LAWS, SITES, RESTITUTIONS, AMPLITUDES))
    assert len(panels(figure)) == 2
    assert legend(figure)[0] == "contact sites [9], contact restitution 0.3"
    assert [axes.get_title(loc="left") for axes in panels(figure)] == [
        "(a) contact law hertz",
        "(b) contact law bilinear",
    ]


def test_categories_alone_are_ticks():
    """A measure over categories alone has a point and a tick for each."""
    (axes,) = panels(only(ensemble_of(SITES)))
    assert [text.get_text() for text in axes.get_xticklabels()] == ["[9]", "[9, 20]", "[4, 30]"]
    # A line between categories would suggest values between them.
    assert all(line.get_linestyle() == "None" for line in axes.lines)


def test_keys_that_vary_together_are_named_together():
    together = {"contacts.sites": [[9], [9, 20], [9]], "drive.cycles": [4, 4, 6]}
    figure = only(ensemble_of(together, AMPLITUDES))
    assert legend(figure)[1] == "contact sites [9, 20], drive cycles 4"
    # Keys in a zip are one axis, whose curves need the values of both.
    pairs = {"drive.frequency": [900.0, 1000.0, 1100.0], "drive.cycles": [3, 4, 5]}
    labels = [text.translate(BLANKS) for text in legend(only(ensemble_of(pairs, AMPLITUDES)))]
    assert labels[1] == "drive frequency 1000 rad/s, drive cycles 4"


def test_what_does_not_vary_stands_nowhere():
    """Keys with one value are neither in names nor in titles of pages."""
    # An axis of one value distinguishes no page from another.
    figure = drawn(ensemble_of({"contacts.law": ["hertz"]}, {"lattice.reading": ["printed"]}, AMPLITUDES))
    (stem,) = figure
    assert stem == "ibtet-over-drive.amplitude"
    text = title(figure[stem])
    assert "hertz" not in text
    assert "printed" not in text
    assert "contacts.law" not in text


def test_many_keys_are_panels_and_pages_each_with_a_name_of_its_own():
    layers = {"lattice.cells": [40, 50, 60, 70, 80, 90]}
    ensemble = ensemble_of(layers, {"drive.cycles": [3, 4, 5, 6]}, CLEARANCES, LAWS, AMPLITUDES)
    figures = drawn(ensemble)
    # Maps of cells over amplitude: two laws and four clearances are panels, four numbers of cycles pages.
    assert len(figures) == 4
    assert {len(panels(figure)) for figure in figures.values()} == {8}
    assert "drive cycles 3" in title(next(iter(figures.values())))


def test_a_study_of_too_many_pages_is_cut_through_its_largest_value():
    wide = [{f"drive.{key}": list(range(1, 5))} for key in ("cycles", "frequency", "ramp", "duration")]
    figures = drawn(
        ensemble_of(*wide, {"drive.band": list(range(1, 9))}, {"contacts.radius": [1.0, 2.0, 3.0, 4.0, 5.0]})
    )
    # The study has more pages than are drawn.
    assert MOST_PAGES < 4**3
    (figure,) = figures.values()
    assert "through the largest value: " in title(figure)


def test_bands_are_curves_of_their_own_and_other_parts_stay_out():
    ensemble = ensemble_of(AMPLITUDES, parts=4)
    figure = only(ensemble, "bands/share")
    assert legend(figure) == ["band 1", "band 2", "band 3"]
    # Several curves of one member have no common largest value.
    assert "largest" not in title(figure)
    (axes,) = panels(figure)
    np.testing.assert_allclose(curves(axes)[0].get_ydata(), ensemble["bands/share"][:, 1])


def test_samples_are_a_mean_and_a_band():
    """A page over samples shows the mean and the band of 5 to 95 % quantiles."""
    ensemble = with_samples(AMPLITUDES)
    figure = only(ensemble)
    (axes,) = panels(figure)
    (band,) = axes.collections
    # The reference is xarray's quantiles of the members.
    low, high = (ensemble["ibtet"].quantile(end, dim="seed").values for end in (0.05, 0.95))
    edges = band.get_paths()[0].vertices
    assert edges[:, 1].min() == pytest.approx(low.min())
    assert edges[:, 1].max() == pytest.approx(high.max())
    assert "means over 8 samples; bands: 5 to 95 % of the samples" in title(figure)
    assert "disorder.seed" not in title(figure)


@pytest.mark.parametrize(
    ("failed", "missing", "means", "failures"),
    [
        # Seeds of failed members with the indices of their amplitudes; seeds that lack this measure alone.
        ({}, {}, "8 samples", ""),
        ({1: range(6), 5: range(6)}, {}, "6 of 8 samples", "12 of 48 members failed"),
        ({1: [0], 5: [0, 3]}, {}, "6 to 8 of 8 samples", "3 of 48 members failed"),
        ({seed: [2] for seed in range(8)}, {}, "0 to 8 of 8 samples", "8 of 48 members failed"),
        ({}, {7: [0]}, "7 to 8 of 8 samples", ""),
    ],
)
def test_a_page_counts_the_samples_that_have_a_value(failed, missing, means, failures):
    """The title has the number of samples that the means are over, and of members that failed."""
    ensemble = ensemble_of({"disorder.seed": list(range(8))}, AMPLITUDES)
    for seed, places in failed.items():
        for name in ("ibtet", "contact_episodes"):
            ensemble[name][seed, list(places)] = np.nan
    for seed, places in missing.items():
        ensemble["ibtet"][seed, list(places)] = np.nan
    text = title(only(sampled(ensemble)))
    assert f"means over {means};" in text
    assert failures in text
    assert ("members failed" in text) == bool(failures)


def test_samples_alone_that_failed_are_counted():
    """A page over seeds says how many of them have a value."""
    ensemble = ensemble_of({"disorder.seed": list(range(8))})
    for name in ("ibtet", "contact_episodes"):
        ensemble[name][[2, 6]] = np.nan
    text = title(only(sampled(ensemble)))
    assert "of 6 of 8 samples" in text
    assert "2 of 8 members failed" in text


def test_samples_alone_are_points_over_their_seeds():
    figures = drawn(with_samples())
    assert list(figures) == ["ibtet-over-disorder.seed"]
    (figure,) = figures.values()
    assert legend(figure) == ["mean 0.045, 5 to 95 % of samples: 0.0135 to 0.0765"]


def test_members_that_failed_are_gaps_and_counted():
    ensemble = ensemble_of(RESTITUTIONS, AMPLITUDES)
    for name in ("ibtet", "contact_episodes"):
        ensemble[name][0, 2] = np.nan
    figure = only(ensemble)
    (axes,) = panels(figure)
    assert np.isnan(curves(axes)[0].get_ydata()[2])
    assert "1 of 12 members failed" in title(figure)


def test_a_value_that_is_not_finite_is_no_largest():
    ensemble = ensemble_of(AMPLITUDES)
    ensemble["ibtet"][0] = np.inf
    assert "largest (ring): 0.06 at drive amplitude 32 N" in title(only(ensemble))


def test_what_cannot_be_drawn_has_a_reason():
    ensemble = ensemble_of(AMPLITUDES)
    assert reason_without_page(ensemble, "ibtet", by_name=True) == ""
    # A measure that is zero for all members has no page unless it is requested by name.
    zero = ensemble.assign(ibtet=0 * ensemble["ibtet"])
    assert reason_without_page(zero, "ibtet", by_name=False) == "0 for every member"
    assert reason_without_page(zero, "ibtet", by_name=True) == ""
    empty = ensemble.assign(ibtet=np.nan * ensemble["ibtet"])
    assert reason_without_page(empty, "ibtet", by_name=True) == "no member has a value"
    single = ensemble_of({"drive.amplitude": [1.0]})
    assert "one member" in reason_without_page(single, "ibtet", by_name=True)


def test_measures_are_what_is_measured_of_every_member():
    """Measures with pages are those with a value, or values of bands, for every member."""
    ensemble = ensemble_of(LAWS, AMPLITUDES, parts=3)
    # A fit has no value for every member, and a history has several for each: neither is a measure with a page.
    ensemble["fits/ibtet/exponent"] = ("law", [1.0, 2.0])
    ensemble["entropy/history"] = (("law", "amplitude", "snapshot"), np.ones((2, 6, 9)))
    assert measures_of(ensemble) == ["contact_episodes", "ibtet", "bands/share"]


@pytest.mark.parametrize("drive", [{}, {"end": "left"}, {"waveform": "impulse"}])
def test_the_amplitude_has_the_unit_of_its_drive(drive):
    (axis,) = SweptAxis.all_of(ensemble_of(AMPLITUDES, drive=drive))
    unit = "m" if "end" in drive else "N s" if drive else "N"
    assert axis.label == f"Drive amplitude ({unit})"


@pytest.mark.parametrize(
    ("path", "unit"),
    [("contacts.clearance", "m"), ("contacts.restitution", ""), ("lattice.cell.masses", "kg"), ("disorder.seed", "")],
)
def test_units_are_those_of_the_manual(path, unit):
    assert unit_of(path, {}) == unit


def test_values_are_distinguished_in_few_digits():
    (axis,) = SweptAxis.all_of(ensemble_of({"drive.frequency": [1000.0, 1000.5, 1100.0]}))
    assert axis.value_texts == ["1000", "1000.5", "1100"]
    (axis,) = SweptAxis.all_of(ensemble_of({"drive.frequency": [600.0, 1000.0, 1100.0]}))
    assert axis.value_texts == ["600", "1000", "1100"]
    # Lists too long to print differ at their ends alone.
    long = [[*range(40)], [*range(41)]]
    (axis,) = SweptAxis.all_of(ensemble_of({"contacts.sites": long}))
    assert len(set(axis.texts)) == 2


@pytest.mark.parametrize("low", [0.2, 1.0, 3.0, 9.5])
@pytest.mark.parametrize("ratio", [1.5, 3.0, 12.0, 300.0, 1e9])
def test_a_logarithmic_axis_has_three_labels_at_least(low, ratio):
    ticks = log_ticks(low, low * ratio)
    assert 3 <= len(ticks) <= 10
    # Ticks are rounded: the outermost ones may lie outside by a rounding error.
    assert low * 0.999 <= min(ticks)
    assert max(ticks) <= low * ratio * 1.001


def test_a_short_logarithmic_axis_has_three_labels_within_its_ends():
    """An axis from 6.05 to 10.1 has three labels inside, though a linear axis would have two, 7.5 and 9."""
    ticks = log_ticks(6.05, 10.1)
    assert len(ticks) >= 3
    assert min(ticks) >= 6.05
    assert max(ticks) <= 10.1


def test_labels_of_a_logarithmic_axis_are_round():
    assert log_ticks(1.0, 12.0) == [1, 3, 10]
    assert log_ticks(0.9, 1100.0) == [1, 10, 100, 1000]
    assert log_ticks(0.2, 1.1) == [0.2, 0.5, 1]


def test_edges_of_a_map_lie_between_its_positions():
    np.testing.assert_allclose(cell_edges(np.array([1.0, 2.0, 4.0]), "linear"), [0.5, 1.5, 3.0, 5.0])
    np.testing.assert_allclose(cell_edges(np.array([1.0, 4.0, 16.0]), "log"), [0.5, 2.0, 8.0, 32.0])


def test_scales_follow_the_spacing():
    assert even_scale(np.geomspace(1, 100, 7)) == "log"
    assert even_scale(np.linspace(1, 100, 7)) == "linear"
    # A negative value has no logarithm.
    assert even_scale(np.array([-1.0, 1.0, 10.0])) == "linear"


def test_a_lattice_of_one_band_has_its_page():
    ensemble = ensemble_of(RESTITUTIONS, AMPLITUDES, parts=2)
    figure = only(ensemble, "bands/share")
    assert legend(figure) == ["contact restitution 0.3", "contact restitution 0.9"]
    np.testing.assert_allclose(curves(panels(figure)[0])[0].get_ydata(), ensemble["bands/share"][0, :, 1])

    without = ensemble_of(AMPLITUDES, parts=1)
    assert reason_without_page(without, "bands/share", by_name=True) == "the cell has no pass band"


def test_samples_of_bands_are_those_of_the_bands():
    ensemble = ensemble_of({"disorder.seed": list(range(8))}, {"contacts.law": ["hertz"]}, parts=3)
    for name in ("contact_episodes", "bands/share"):
        values = ensemble[name]
        quantiles = values.quantile([0.05, 0.95], dim="seed")
        ensemble[f"statistics/{name}/mean"] = values.mean("seed")
        ensemble[f"statistics/{name}/quantiles"] = quantiles.drop_vars("quantile")
    ensemble["statistics/samples"] = ensemble["contact_episodes"].count("seed")
    figures = drawn(ensemble, "bands/share")
    assert list(figures) == ["bands_share-over-disorder.seed-band"]
    points = [line for line in panels(figures.popitem()[1])[0].lines if line.get_label().startswith("samples")]
    np.testing.assert_allclose([line.get_ydata() for line in points], ensemble["bands/share"][:, 0, 1:].T)


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [0, 1, 2, 3])
@pytest.mark.parametrize("words", [0, 1, 2])
def test_every_combination_of_keys_is_drawn(numbers, words):
    """Names of pages contain every key, and differ."""
    axes = [AMPLITUDES, CLEARANCES, THREE][:numbers] + [LAWS, SITES][:words]
    if not axes:
        return
    ensemble = ensemble_of(*axes, parts=3)
    stems = [drawing.stem for name in measures_of(ensemble) for drawing in measure_pages(ensemble, name)]
    assert len(set(stems)) == len(stems) >= 3
    for stem, axis in product(stems, axes):
        assert all(path in stem for path in axis)
    assert next(measure_pages(ensemble, "bands/share")).draw().axes


def test_roles_do_not_depend_on_equal_sizes():
    """Three keys with equal numbers of values have the roles x, y and panels in the order of the case."""
    same = [{"drive.frequency": [1.0, 2.0, 3.0]}, {"drive.ramp": [1.0, 2.0, 3.0]}, {"drive.duration": [1.0, 2.0, 3.0]}]
    roles = Roles.of(Measure.of(ensemble_of(*same), "ibtet").axes)
    assert roles.y is not None
    assert [roles.x.label, roles.y.label] == ["Drive frequency (rad/s)", "Drive ramp (s)"]
    assert [axis.label for axis in roles.panels] == ["Drive duration (s)"]


OWN = {
    "cells": 30,
    "cell": {
        "masses": [0.01, 0.002],
        "springs": [
            {"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True},
            {"start": 1, "end": 2, "stiffness": 1e3},
        ],
        "contact": [1, 2],
    },
}
STOPS = {"modulus": 1e8, "radius": 0.005, "poisson": 0.3, "sites": [10, 15], "clearance": 1e-3}


@pytest.mark.parametrize(
    ("table", "name"),
    [
        ({"lattice": {"preset": "four-band"}}, "Hertz, calibrated, 5 sites, 30 cycles, 24.33 N"),
        (
            {
                "lattice": OWN,
                "contacts": STOPS,
                "drive": {"waveform": "harmonic", "frequency": 900.0, "amplitude": 12.0},
                "time": {"end": 0.1},
            },
            "Hertz, 2 sites, 12 N",
        ),
    ],
)
def test_a_case_is_named_by_what_applies_to_it(table, name):
    """The name of a case omits the reading of a cell that is no preset and the cycles of a harmonic drive."""
    case = Case.from_table({"name": "tried"} | table)
    assert Labels.of(case).member == name
    assert Labels.of(case, "drive.ramp 2 s").page.endswith("drive.ramp 2 s")


def test_pages_of_several_sweeps_have_common_axes():
    """Pages of two sweeps, one of larger values over higher amplitudes, have common limits of axes and colours."""
    higher = {"drive.amplitude": [8.0, 16.0, 32.0, 64.0, 128.0, 256.0]}
    for axes in ([RESTITUTIONS], [CLEARANCES]):
        sweeps = [ensemble_of(*axes, AMPLITUDES), ensemble_of(*axes, higher)]
        sweeps[1]["ibtet"] *= 7
        figures = []
        for ensemble, other in (sweeps, sweeps[::-1]):
            (drawing,) = measure_pages(ensemble, "ibtet", "name", [other])
            figures.append(drawing.draw())
        first, second = (panels(figure)[0] for figure in figures)
        np.testing.assert_allclose(first.get_xlim(), second.get_xlim())
        np.testing.assert_allclose(first.get_ylim(), second.get_ylim())
        meshes = [shape for page in (first, second) for shape in page.collections if isinstance(shape, QuadMesh)]
        assert len({mesh.get_clim() for mesh in meshes}) <= 1


def test_pages_over_categories_have_a_common_scale_of_the_measure():
    """Axes of categories belong to each page; axes of the values over them have common limits."""
    sweeps = [ensemble_of(SITES), ensemble_of(SITES)]
    sweeps[1]["ibtet"] *= 7
    limits = []
    for ensemble, other in (sweeps, sweeps[::-1]):
        (drawing,) = measure_pages(ensemble, "ibtet", "name", [other])
        (axes,) = panels(drawing.draw())
        assert axes.get_xlim() == (-0.5, 2.5)
        limits.append(axes.get_ylim())
    assert limits[0] == limits[1]
    assert limits[0][1] > 0.21


def test_a_band_that_reaches_below_zero_is_shown_whole():
    """An axis of positive means begins at 0 only if the band of samples does not reach below."""
    ensemble = with_samples(AMPLITUDES)
    # The smallest mean is less than half of the largest.
    ensemble["statistics/ibtet/mean"][0] = 0.01
    ensemble["statistics/ibtet/quantiles"][0] = -1.0
    (axes,) = panels(only(ensemble))
    low, _ = axes.get_ylim()
    assert low <= -1.0


def test_pages_can_be_read(tmp_path):
    """Pages of curves, maps and panels, also with long names, have no text outside the page or over other text."""
    for axes in (
        [AMPLITUDES],
        [RESTITUTIONS, AMPLITUDES],
        [CLEARANCES, THREE],
        [LAWS, SITES, RESTITUTIONS, AMPLITUDES],
    ):
        for drawing in measure_pages(ensemble_of(*axes), "ibtet"):
            figure = drawing.draw()
            save(figure, tmp_path / "page.png")
            assert complaints(figure) == []
