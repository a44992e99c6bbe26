"""A strip of the plane is a chain of wide cells: its bands by formula, its ends and edges, what it writes."""

import numpy as np
import pytest

from vipetsc.case import Case, CaseError
from vipetsc.lattice import Chain, bloch
from vipetsc.lattice.plane import PlaneCell, PlaneSpring, honeycomb, square, triangular

K, M = 1e4, 0.01
W2 = K / M  # (rad/s)^2


def strip_table(rows=4, cells=6, ends="fixed", drive=None, time=None, **keys):
    strip = {"rows": rows, "mass": M, "stiffness": K} | keys
    return {
        "lattice": {"cells": cells, "ends": ends, "strip": strip},
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
@pytest.mark.parametrize("rows", [1, 2, 5, 6])
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
@pytest.mark.parametrize("ends", ["free", "fixed", "periodic"])
@pytest.mark.parametrize("in_plane", [False, True])
@pytest.mark.parametrize("plane", [square(M, K, K / 2), triangular(M, K, K), honeycomb(M, K, 3 * K), DIAGONALS])
def test_stiffness_of_a_strip_is_put_together_bond_by_bond(plane, in_plane, ends, edges):
    if in_plane and ends == "free":
        pytest.skip("refused")
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


def test_resolved_strip_reads_back_and_a_key_replaces_one():
    case = strip_case(kind="honeycomb", rows=3)
    assert Case.from_toml(case.to_toml()) == case
    wider = case.varied(lattice={"strip": {"rows": 5}})
    assert wider.model().chain.cell == strip_case(kind="honeycomb", rows=5).model().chain.cell


@pytest.mark.parametrize(
    ("key", "word", "strip"),
    [
        ("lattice.strip.masses", "kind", {"masses": [1.0]}),
        ("lattice.strip.springs", "missing", {"kind": "cell"}),
        ("lattice.strip.motion", "shear", {"motion": "in-plane"}),
        ("lattice.ends", "cut", {"motion": "in-plane", "kind": "triangular", "ends": "free"}),
        ("lattice.strip.rows", "springs", {"rows": 20_000}),
        ("lattice.strip.row", "rows", {"row": 2}),
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
