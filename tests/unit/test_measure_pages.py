"""Pages of a sweep's measures name the keys that vary, and draw any number of them; nothing is simulated."""

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
from vipetsc.case.sweep import coordinate
from vipetsc.figures.measure_pages import measure_pages, reason_without_page
from vipetsc.figures.style import rc_style, save
from vipetsc.figures.sweep_members import Labels

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
    assert "largest (ring): 0.12 at contact restitution 0.9, drive amplitude 32 N" in title(figure)


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


def test_words_and_lists_are_curves_and_panels_with_their_values():
    figure = only(ensemble_of(LAWS, SITES, RESTITUTIONS, AMPLITUDES))
    assert len(panels(figure)) == 2
    assert legend(figure)[0] == "contact sites [9], contact restitution 0.3"
    assert [axes.get_title(loc="left") for axes in panels(figure)] == [
        "(a) contact law hertz",
        "(b) contact law bilinear",
    ]


def test_many_keys_are_panels_and_pages_each_with_a_name_of_its_own():
    layers = {"lattice.cells": [40, 50, 60, 70, 80, 90]}
    ensemble = ensemble_of(layers, {"drive.cycles": [3, 4, 5, 6]}, CLEARANCES, LAWS, AMPLITUDES)
    figures = drawn(ensemble)
    # Maps of cells over amplitude: two laws and four clearances are panels, four numbers of cycles pages.
    assert len(figures) == 4
    assert {len(panels(figure)) for figure in figures.values()} == {8}
    assert "drive cycles 3" in title(next(iter(figures.values())))


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
