"""A strip of the plane is a chain of wide cells: its bands by formula, its ends and edges, what it writes."""

import numpy as np
import pytest

from vipetsc.case import Case, CaseError
from vipetsc.case.keys import json_schema
from vipetsc.figures.strips import bands
from vipetsc.figures.style import rc_style
from vipetsc.lattice import Chain, bloch
from vipetsc.lattice.plane import PlaneCell, PlaneSpring, honeycomb, square, triangular

K, M = 1e4, 0.01
W2 = K / M  # (rad/s)^2


IN_PLANE = {"motion": "in-plane", "kind": "triangular"}


def strip_table(rows=4, cells=6, ends="fixed", drive=None, time=None, profiles=None, **keys):
    strip = {"rows": rows, "mass": M, "stiffness": K} | keys
    return {
        "lattice": {"cells": cells, "ends": ends, "strip": strip} | ({"profiles": profiles} if profiles else {}),
        "drive": {"amplitude": 1.0, "frequency": 1000.0} | (drive or {}),
        "time": {"end": 0.01} | (time or {}),
        "output": {"figures": False},
    }


def strip_case(**keys):
    return Case.from_table(strip_table(**keys))


def squared(kind, k1, k2):
    """Squares (branch,) of the plane's frequencies over k/m, by the formulas of textbooks."""
    if kind == "square":
        return [4 * (np.sin(k1 / 2) ** 2 + np.sin(k2 / 2) ** 2)]
    if kind == "triangular":
        return [2 * (3 - np.cos(k1) - np.cos(k2) - np.cos(k1 - k2))]
    root = abs(1 + np.exp(1j * k1) + np.exp(1j * k2))
    return [3 - root, 3 + root]


@pytest.mark.parametrize("kind", ["square", "triangular", "honeycomb"])
@pytest.mark.parametrize("rows", [1, 5, 6])
def test_bands_of_a_strip_with_periodic_edges_are_those_of_the_plane(kind, rows):
    cell = strip_case(kind=kind, rows=rows, edges="periodic").model().chain.cell
    for kappa in (0.0, 0.7, 2.3, np.pi):
        waves = 2 * np.pi * np.arange(rows) / rows
        exact = np.sort(np.concatenate([squared(kind, kappa, wave) for wave in waves]))
        found = bloch(cell, kappa).frequency ** 2 / W2
        np.testing.assert_allclose(found, exact, rtol=0, atol=1e-13)


def test_free_and_fixed_edges_have_the_standing_waves_of_a_chain():
    """The modes across are those of a chain with such ends: pi n/rows, and pi n/(rows + 1) with walls."""
    rows, kappa = 5, 0.7
    for edges, waves in (("free", np.arange(rows) / rows), ("fixed", np.arange(1, rows + 1) / (rows + 1))):
        cell = strip_case(rows=rows, edges=edges).model().chain.cell
        exact = np.sort(np.concatenate([squared("square", kappa, np.pi * wave) for wave in waves]))
        np.testing.assert_allclose(bloch(cell, kappa).frequency ** 2 / W2, exact, rtol=0, atol=1e-13)


def assembled(plane, shape, ends, edges):
    """The stiffness of ``shape`` cells of the plane, put together bond by bond."""
    n, rows = shape
    d = plane.dofs
    walls = (ends, edges)
    matrix = np.zeros((n * rows * d, n * rows * d))

    def inside(place):
        """The cell of a place; None in a wall, False where there is nothing. Corners belong to the edges."""
        cell = []
        for at, size, wall in zip(place[::-1], shape[::-1], walls[::-1], strict=True):
            if wall == "periodic":
                at %= size
            elif not 0 <= at < size:
                return None if wall == "fixed" else False
            cell.append(at)
        return tuple(cell[::-1])

    for spring in plane.springs:
        n_vector = np.array(spring.direction if plane.in_plane else (1.0,))
        block = spring.stiffness * np.outer(n_vector, n_vector)
        for i in range(-2, n + 2):
            for j in range(-2, rows + 2):
                begin = inside((i, j))
                end = inside((i + spring.offset[0], j + spring.offset[1]))
                # Of a spring that begins beyond a ring's seam there is one that begins before it.
                if ends == "periodic" and not 0 <= i < n:
                    continue
                if edges == "periodic" and not 0 <= j < rows:
                    continue
                if begin is False or end is False or (begin is None and end is None):
                    continue
                c = len(n_vector)
                places = []
                for cell, mass in ((begin, spring.start), (end, spring.end)):
                    places.append(None if cell is None else (cell[0] * rows + cell[1]) * d + mass * c)
                for a, p in enumerate(places):
                    for b, q in enumerate(places):
                        if p is not None and q is not None:
                            matrix[p : p + c, q : q + c] += block if a == b else -block
    return matrix


DIAGONALS = PlaneCell(
    (M, 2 * M),
    (
        PlaneSpring(0, 1, K),
        PlaneSpring(1, 0, 2 * K, (1, 0)),
        PlaneSpring(0, 0, K, (0, 1), (0.0, 1.0)),
        PlaneSpring(1, 1, K / 2, (0, 1), (0.0, 1.0)),
        PlaneSpring(0, 1, K / 3, (-1, 1), (-0.6, 0.8)),
        PlaneSpring(0, 1, K / 3, (0, -1), (0.6, -0.8)),
    ),
)


@pytest.mark.parametrize("edges", ["free", "fixed", "periodic"])
# Motion in the plane is refused with free ends: see ``test_refused_strips``.
@pytest.mark.parametrize(
    ("in_plane", "ends"), [(False, "free"), (False, "fixed"), (False, "periodic"), (True, "fixed"), (True, "periodic")]
)
@pytest.mark.parametrize("plane", [square(M, K, K / 2), triangular(M, K, K), honeycomb(M, K, 3 * K), DIAGONALS])
def test_stiffness_of_a_strip_is_put_together_bond_by_bond(plane, in_plane, ends, edges):
    plane = PlaneCell(plane.masses, plane.springs, in_plane=in_plane)
    for rows in (3, 4):
        springs = plane.wide_springs(rows, edges)
        cell = Case.from_table(strip_table()).model().chain.cell
        cell = type(cell)(tuple(plane.wide_masses(rows)), tuple(springs), 0, 1)
        found = Chain(cell, 4, ends).stiffness_matrix().toarray()
        np.testing.assert_allclose(found, assembled(plane, (4, rows), ends, edges), rtol=0, atol=1e-11 * K)


def test_long_waves_of_the_triangular_lattice_in_the_plane_are_isotropic():
    """Of equal springs c_p = sqrt(3) c_s, in every direction."""
    named = triangular(M, K, K)
    plane = PlaneCell(named.masses, named.springs, named.vectors, named.positions, in_plane=True)
    small = 1e-3
    for angle in (0.0, 0.4, 1.1, 2.0):
        wave = small * np.array([np.cos(angle), np.sin(angle)])
        k1, k2 = (wave @ np.array(vector) for vector in plane.vectors)
        slow, fast = plane.frequencies(k1, k2) / small
        np.testing.assert_allclose(fast / slow, np.sqrt(3), rtol=1e-5)
        np.testing.assert_allclose(slow, np.sqrt(3 * W2 / 8), rtol=1e-5)


def test_a_strip_of_one_row_is_the_chain():
    chain = strip_table(cells=9)
    chain["lattice"] = {
        "cells": 9,
        "cell": {"masses": [M], "springs": [{"start": 1, "end": 1, "stiffness": K, "next_cell": True}]},
    }
    of_strip = strip_case(rows=1, cells=9).model()
    assert of_strip == Case.from_table(chain).model()


@pytest.mark.parametrize(
    ("key", "word", "strip"),
    [
        ("lattice.strip.masses", "kind", {"masses": [1.0]}),
        ("lattice.strip.springs", "missing", {"kind": "cell"}),
        ("lattice.strip.motion", "shear", {"motion": "in-plane"}),
        ("lattice.ends", "cut", {"motion": "in-plane", "kind": "triangular", "ends": "free"}),
        ("lattice.strip.rows", "springs", {"rows": 20_000}),
        ("lattice.strip.row", "rows", {"row": 2}),
        ('lattice.profiles."masses[1]"', "masses[2]", IN_PLANE | {"profiles": {"masses[1]": [M] * 6}}),
        ('lattice.profiles."masses[6]"', "masses[5]", IN_PLANE | {"profiles": {"masses[6]": [M] * 6}}),
        ('lattice.profiles."springs[1].stiffness"', "several",
            IN_PLANE | {"profiles": {"springs[1].stiffness": [K] * 6}}),
        ("lattice.strip.springs[1].offset", "-1", {"kind": "cell", "mass": None, "stiffness": None, "masses": [M],
            "springs": [{"start": 1, "end": 1, "stiffness": K, "offset": [2, 0]}]}),
    ],
)  # fmt: skip
def test_refused_strips(key, word, strip):
    table = strip_table(**strip)
    table["lattice"]["strip"] = {k: v for k, v in table["lattice"]["strip"].items() if v is not None}
    with pytest.raises(CaseError) as error:
        Case.from_table(table)
    assert any(problem.key == key and word in problem.remedy for problem in error.value.problems)


def run_table(places=(), **keys):
    """A square strip of 12 x 5 cells with a harmonic drive on one mass and, at some places, stops to the ground."""
    table = strip_table(rows=5, cells=12, **keys)
    table["drive"] = {"amplitude": 20.0, "waveform": "harmonic", "frequency": 1000.0, "place": [3, 2]}
    if places:
        contacts = {"places": places, "clearance": 1e-4, "stiffness": 1e8, "restitution": 0.8}
        table["contacts"] = contacts
    return table


def test_a_point_without_a_place_is_asked_for_cell_or_place():
    table = run_table()
    table["output"]["points"] = [{"name": "far"}]
    with pytest.raises(CaseError, match=r"output.points\[1\].cell: missing; .*place"):
        Case.from_table(table)


def test_places_are_cells_and_masses():
    table = run_table(places=[[4, 1], [4, 5], [9, 3]], drive={})
    table["output"]["points"] = [{"name": "far", "place": [12, 5]}]
    table["initial"] = {"kind": "velocity", "place": [2, 4], "velocity": 0.1}
    case = Case.from_table(table)
    assert (case.drive.cell, case.drive.mass) == (3, 2)
    assert case.contacts.sites == [4, 4, 9]
    assert [tuple(site.pair) for site in case.model().chain.sites] == [(-1, 0, 0), (-1, 4, 0), (-1, 2, 0)]
    assert (case.output.points[0].cell, case.output.points[0].mass) == (12, 5)
    assert (case.initial.cell, case.initial.mass) == (2, 4)
    assert Case.from_toml(case.to_toml()) == case


def test_masses_and_offsets_of_contacts_count_in_the_cell_of_the_plane():
    table = strip_table(rows=3, cells=6, kind="honeycomb", edges="periodic")
    contacts = {"clearance": 1e-4, "stiffness": 1e8, "places": [[2, 3]], "pair": [2, 1]}
    for offset, pair in (([0, 0], (5, 4, 0)), ([0, 1], (5, 0, 0)), ([1, 0], (5, 4, 1))):
        case = Case.from_table(table | {"contacts": contacts | {"offset": offset}})
        assert tuple(case.model().chain.sites[0].pair) == pair


PATTERNS = {
    "row": ({"row": 2, "every": 4}, [[1, 2], [5, 2], [9, 2]]),
    "column": ({"column": 7}, [[7, j] for j in range(1, 6)]),
    "line": ({"line": [[4, 1], [8, 5]]}, [[4, 1], [5, 2], [6, 3], [7, 4], [8, 5]]),
    "disc": ({"centre": [3, 3], "radius": 1}, [[2, 3], [3, 2], [3, 3], [3, 4], [4, 3]]),
    "within": ({"within": [[5, 2], [4, 1]]}, [[4, 1], [4, 2], [5, 1], [5, 2]]),
}


@pytest.mark.parametrize("name", sorted(PATTERNS))
def test_patterns(name):
    pattern, places = PATTERNS[name]
    assert Case.from_table(run_table(pattern)) == Case.from_table(run_table(places))


def test_a_beam_has_phases_and_amplitudes():
    table = run_table()
    table["drive"] = {"amplitude": "2 N", "waveform": "harmonic", "frequency": 1000.0, "places": {"column": 4}}
    table["drive"]["beam"] = {"wavevector": [0.1, 0.5], "width": 1.5}
    drives = Case.from_table(table).model().drives
    assert [(drive.cell, drive.mass) for drive in drives] == [(3, row) for row in range(5)]
    late = np.linspace(0.08, 0.09, 7)  # after the ramp
    for row, drive in enumerate(drives):
        expected = 2 * np.exp(-0.5 * ((row - 2) / 1.5) ** 2) * np.sin(1000 * late - 0.5 * row)
        np.testing.assert_allclose(drive.waveform.force(late), expected, rtol=0, atol=1e-12)


def test_defects_and_scatter_by_place():
    strip = {
        "defects": [
            {"quantity": "masses[1]", "places": [[2, 1], [3, 4]], "factor": 2.0},
            {"quantity": "springs[2].stiffness", "places": [[3, 2]], "value": 5.0},
        ]
    }
    chain = strip_case(**strip).model().chain
    masses = chain.coefficients(0, 6).masses
    exact = np.full((6, 4), M)
    exact[1, 0] = exact[2, 3] = 2 * M
    np.testing.assert_array_equal(masses, exact)
    # The springs along come first, one a row; then those across, which begin in the rows 1 to 3.
    stiffness = chain.coefficients(0, 6).stiffness
    assert np.argwhere(stiffness != K).tolist() == [[2, 4 + 1]] and stiffness[2, 5] == 5.0
    table = strip_table() | {"disorder": {"seed": 3, "cells": {"masses[*]": {"relative": 0.1}}}}
    scattered = Case.from_table(table).model().chain.coefficients(0, 6).masses
    assert len(np.unique(scattered)) == 24 and abs(scattered.mean() / M - 1) < 0.1


def test_both_components_of_a_mass_in_the_plane_may_vary():
    heavy = {"masses[3]": [M, 2 * M] * 3, "masses[4]": [M, 2 * M] * 3}
    defects = [{"quantity": "masses[1]", "places": [[i, 2] for i in (2, 4, 6)], "factor": 2.0}]
    assert strip_case(profiles=heavy, **IN_PLANE).model() == strip_case(defects=defects, **IN_PLANE).model()
    with pytest.raises(CaseError, match="one mass"):
        strip_case(**IN_PLANE).varied(overrides=["lattice.cell.masses[8]=0.02"])


def test_a_point_has_a_cell_or_a_place():
    point = json_schema()["$defs"]["PointTable"]
    assert point["required"] == ["name"]
    assert point["anyOf"] == [{"required": ["cell"]}, {"required": ["place"]}]
    table = run_table() | {"output": {"points": [{"name": "nowhere"}]}}
    with pytest.raises(CaseError, match=r"points\[1\].cell: missing"):
        Case.from_table(table)


# Rows at a free edge of a triangular lattice have two bonds less: none of its standing waves is one of half-waves.
WITH_HALF_WAVES = [("square", "free"), ("square", "fixed"), ("square", "periodic")]
WITH_HALF_WAVES += [("triangular", "fixed"), ("triangular", "periodic")]


@pytest.mark.parametrize(("kind", "edges"), WITH_HALF_WAVES)
def test_bands_have_the_colours_of_their_wave_number_across(kind, edges):
    case = strip_case(kind=kind, rows=5, edges=edges)
    with rc_style():
        figure = bands(case.lattice.cell.from_strip, case.lattice.unit_cell())
    shown = 0
    for sign, lines in zip((1, -1), figure.axes[0].collections[:2], strict=True):
        for segment, across in zip(lines.get_segments(), lines.get_array(), strict=True):
            for kappa, frequency in np.pi * segment * [1, 1e3 / np.pi]:
                lean = kappa / 2 if kind == "triangular" and edges == "fixed" else 0.0
                exact = squared(kind, kappa, sign * np.pi * across + lean)
                np.testing.assert_allclose(frequency**2 / W2, exact, rtol=0, atol=1e-12)
            shown += 1
    assert shown > 180 * 4


@pytest.mark.parametrize(
    ("section", "value", "key", "word"),
    [
        ("contacts", {"places": [{"row": 3}]}, "contacts.places[1]", "the table itself"),
        ("contacts", {"places": [[3, 6]]}, "contacts.places", "outside"),
        ("contacts", {"places": [[3]]}, "contacts.places[1]", "2 items"),
        ("contacts", {"places": {"rows": 3}}, "contacts.places.rows", "row"),
        ("contacts", {"places": {"centre": [3, 3]}}, "contacts.places.radius", "disc"),
        ("contacts", {"places": {"row": 3, "column": 40}}, "contacts.places", "no cell"),
        ("contacts", {"places": [[3, 3]], "pair": [0, 2]}, "contacts.pair", "1 to 1"),
        ("contacts", {"places": [[3, 5]], "pair": [1, 1], "offset": [0, 1]}, "contacts.offset", "edge"),
        ("contacts", {"sites": [3], "offset": [0, 1]}, "contacts.offset", "contacts.places"),
        ("drive", {"place": [13, 1]}, "drive.place", "outside"),
        ("drive", {"place": [3, 1, 2]}, "drive.place", "masses 1 to 1"),
        ("drive", {"place": [3, 1], "mass": 2}, "drive.place", "cell and mass"),
        ("drive", {"place": [3, 1], "beam": {"wavevector": [0, 1]}}, "drive.beam", "places"),
        (
            "drive",
            {"places": {"column": 2}, "waveform": "burst", "beam": {"wavevector": [0, 1]}},
            "drive.phase",
            "burst",
        ),
        ("initial", {"kind": "velocity", "place": [1, 2, 3, 4], "velocity": 1.0}, "initial.place", "at most 3"),
    ],
)
def test_refused_places(section, value, key, word):
    table = run_table()
    if section == "contacts":
        value = {"clearance": 1e-4, "stiffness": 1e8} | value
    if section == "drive":
        value = {"frequency": 1000.0, "waveform": "harmonic"} | value
    with pytest.raises(CaseError) as error:
        Case.from_table(table | {section: value})
    assert any(problem.key == key and word in str(problem) for problem in error.value.problems), str(error.value)
