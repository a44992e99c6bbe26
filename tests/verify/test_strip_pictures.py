"""A run on a strip: energies of its waves by wave vector, its pictures, and its export by cell and row."""

import tomllib
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest

from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.figures import strips
from vipetsc.figures.movie_frames import Shot, check
from vipetsc.figures.style import rc_style
from vipetsc.io.export import write_xdmf
from vipetsc.io.impacts import impacts
from vipetsc.io.read import open_run
from vipetsc.lattice.plane import PlaneCell, honeycomb, square, triangular
from vipetsc.spectra.wave_vectors import wave_vector_energies

M, K = 0.01, 1e4


def table(kind="square", **keys):
    lattice = {"cells": 10, "ends": "periodic", "strip": {"rows": 6, "kind": kind, "mass": M, "stiffness": K} | keys}
    return {
        "name": "strip",
        "lattice": lattice,
        "contacts": {"places": [[4, 2], [7, 5]], "clearance": 2e-4, "stiffness": 1e7},
        "drive": {"amplitude": 20.0, "waveform": "harmonic", "frequency": 1500.0, "place": [3, 2]},
        "time": {"end": 0.04},
        "output": {"figures": False},
    }


@pytest.fixture(scope="module", params=["square", "honeycomb"])
def folder(request, tmp_path_factory):
    path = tmp_path_factory.mktemp(request.param)
    assert simulate(Case.from_table(table(request.param, edges="periodic")), path).complete
    return path


@pytest.mark.parametrize("in_plane", [False, True])
@pytest.mark.parametrize("named", [square, triangular, honeycomb])
def test_a_travelling_wave_has_its_energy_in_its_wave_vector(named, in_plane):
    cell = named(M, K, K)
    plane = PlaneCell(cell.masses, cell.springs, cell.vectors, cell.positions, in_plane)
    shape = 8, 5
    for at in ((1, 2), (6, 0), (3, 4)):
        k = 2 * np.pi * np.array(at) / shape
        frequency, shapes = plane.waves(*k)
        i, j = np.meshgrid(*map(np.arange, shape), indexing="ij")
        for branch, omega in enumerate(frequency):
            wave = np.exp(1j * (k[0] * i + k[1] * j))[..., None] * shapes[:, branch] / plane.roots
            energies = wave_vector_energies(plane, wave.real, (-1j * omega * wave).real)
            exact = np.zeros_like(energies)
            # Of a wave of amplitude 1 in M^(1/2) U kinetic and spring energy are omega^2/4 a cell each.
            exact[at][branch] = omega**2 / 2 * 40
            # Branches that cross share a wave in any way.
            np.testing.assert_allclose(energies.sum(-1), exact.sum(-1), rtol=0, atol=1e-12 * frequency.max() ** 2 * 40)


def test_energies_of_a_torus_add_up_to_the_linear_energy(folder):
    with open_run(folder / "run.h5") as run:
        strip = strips.Strip.of(run)
        for row in (40, -1):
            fields = [strip.by_cell(run[name][row].values) for name in ("displacement", "velocity")]
            total = float(run["energy/kinetic"][row] + run["energy/spring"][row])
            np.testing.assert_allclose(wave_vector_energies(strip.plane, *fields).sum(), total, rtol=1e-11)


def test_fields_are_laid_out_by_cell_and_row(folder):
    with open_run(folder / "run.h5") as run:
        strip = strips.Strip.of(run)
        assert strip.sites.tolist() == [[4, 2], [7, 5]] and strip.drives.tolist() == [[3, 2]]
        assert run["sites/row"].values.tolist() == [2, 5]
        velocity = run["velocity"][30]
        by_name = velocity.isel(dof=(velocity["row"] == 2) & (velocity["mass"] == 1)).sel(cell=3).values
        assert strip.by_cell(velocity.values)[2, 1, 0] == by_name.item()
        np.testing.assert_allclose(
            strip.kinetic(run["velocity"].values).sum((1, 2)), run["energy/kinetic"], rtol=1e-12, atol=1e-16
        )


def test_pictures_and_movies_show_the_cells(folder):
    with rc_style(), open_run(folder / "run.h5") as run:
        snapshots = strips.snapshots(run, None).axes
        shown = snapshots[3].collections[0].get_array()
        np.testing.assert_array_equal(
            np.reshape(shown, (10, 6)), strips.Strip.of(run).by_cell(run["displacement"][-1].values)[..., 0]
        )
        envelope = strips.envelope(run, None).axes[0].collections[0].get_array()
        kinetic = strips.Strip.of(run).kinetic(run["velocity"].values)
        np.testing.assert_array_equal(np.reshape(envelope, (10, 6)), kinetic.max(0))
        content = strips.wave_vectors(run, None).axes[0].images[0].get_array()
        # Both ends of each axis are shown, which are one wave number.
        assert content.shape == (7, 11)
        np.testing.assert_array_equal(content[[0], :], content[[-1], :])
        np.testing.assert_array_equal(content[:, [0]], content[:, [-1]])
        for quantity in ("energy", "velocity"):
            shot = Shot(quantity, width=640)
            film = strips.StripMovie(run, shot, check(run, shot))
            assert film.frame(0).shape == film.frame(1).shape
            assert np.any(film.frame(len(film.content.time) - 1).copy() != film.frame(0))


def test_export_names_cells_and_rows(folder):
    log = impacts(folder)
    assert {*zip(log["cell"], log["row"], strict=True)} <= {(4, 2), (7, 5)} and len(log) > 2
    path = write_xdmf(folder)
    tree = ElementTree.parse(path).getroot()
    with open_run(folder / "run.h5") as run, h5py.File(folder / "run.h5") as file:
        dofs = run.sizes["dof"] // 6
        grid = tree.findall(".//Grid[@GridType='Uniform']")[25]
        mesh = [tree.find(f"Domain/{name}") for name in ("Topology", "Geometry")]
        if is_square := mesh[0] is None:
            mesh = [grid.find(name) for name in ("Topology", "Geometry")]
        else:
            assert {part.get("Reference") for part in grid} >= {f"/Xdmf/Domain/{part.tag}[1]" for part in mesh}
        assert mesh[0].get("Dimensions") == "10 6"
        numbers = [np.array(item.text.split(), float) for item in mesh[1].findall("DataItem")]
        i, j = np.meshgrid(np.arange(1.0, 11), np.arange(1.0, 7), indexing="ij")
        if is_square:
            assert mesh[0].get("TopologyType") == "2DCoRectMesh"
            np.testing.assert_array_equal(numbers, [[1, 1], [1, 1]])
        else:
            # Rows of the honeycomb lattice lean by 60 degrees.
            exact = np.stack([i + 0.5 * j, np.sqrt(0.75) * j], axis=-1)
            np.testing.assert_allclose(numbers[0].reshape(10, 6, 2), exact, rtol=1e-15)
        attributes = grid.findall("Attribute")
        assert len(attributes) == 2 * dofs
        for number, attribute in enumerate(attributes):
            slab, source = attribute.findall("DataItem/DataItem")
            start, stride, count = np.array(slab.text.split(), int).reshape(3, 3)
            place = tuple(slice(a, a + n * step, step) for a, step, n in zip(start, stride, count, strict=True))
            name = source.text.partition(":/")[2]
            by_cell = strips.Strip.of(run).by_cell(run[name][25].values)
            np.testing.assert_array_equal(file[name][place][0], by_cell[..., number % dofs])
    assert "from_strip" in tomllib.loads(run.attrs["case"])["lattice"]["cell"]
