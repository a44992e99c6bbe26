"""Strips: energies by wave vector, pictures, export, rays, modes, responses and fits."""

import tomllib
from xml.etree import ElementTree

from mpi4py import MPI

import h5py
import numpy as np
import pytest

import vipetsc
from tests.conftest import simulated
from vipetsc.case import Case
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.dynamics import simulate
from vipetsc.figures import strips
from vipetsc.figures.movie_frames import Shot, check
from vipetsc.figures.style import rc_style
from vipetsc.io.branch_kinds import kind_names
from vipetsc.io.export import write_xdmf
from vipetsc.io.impacts import impacts
from vipetsc.io.read import open_run
from vipetsc.lattice.plane import PlaneCell, honeycomb, square, triangular
from vipetsc.modes.branches.follow import follow_all
from vipetsc.spectra.wave_vectors import wave_vector_energies
from vipetsc.studies.identification import run_identification

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


M, K = 0.01, 1e4
RATE = np.sqrt(K / M)  # rad/s


def strip(rows, cells, ends="fixed", edges="fixed", **keys):
    return {"cells": cells, "ends": ends, "strip": {"rows": rows, "mass": M, "stiffness": K, "edges": edges} | keys}


def energy_at(run, places):
    """Mean kinetic energy in J of the masses at places (i, j), from 0, over the last quarter of a run."""
    late = run["velocity"].values[-len(run["time"]) // 4 :]
    return float(np.mean([0.5 * M * late[:, i, j] ** 2 for i, j in places]))


def test_a_resonant_point_drive_sends_rays_along_the_diagonals():
    """At omega^2 = 4 k/m all waves with |k_1| + |k_2| = pi go along diagonals; long waves go all round."""
    middle = 20
    reach = 9
    diagonal = round(reach / np.sqrt(2))
    ratio = {}
    for frequency in (0.7, 2.0):
        table = {
            "lattice": strip(41, 41, ends="free", edges="free"),
            "drive": {
                "amplitude": 1.0,
                "waveform": "harmonic",
                "frequency": frequency * RATE,
                "place": [middle + 1, middle + 1],
            },
            "contacts": {"sites": []},
            "time": {"end": 0.034, "engine": "ts", "rtol": 1e-6},
        }
        run, _ = simulated(Case.from_table(table))
        signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
        along = [(middle + reach * a, middle) for a in (-1, 1)] + [(middle, middle + reach * a) for a in (-1, 1)]
        across = [(middle + diagonal * a, middle + diagonal * b) for a, b in signs]
        ratio[frequency] = energy_at(run, across) / energy_at(run, along)
    assert ratio[2.0] > 30
    assert 0.5 < ratio[0.7] < 2


@pytest.mark.parametrize("edges", ["free", "fixed", "periodic"])
def test_a_curved_spring_pulls_alike_seen_from_either_end(edges):
    """Seen from its other end the elongation has the other sign, and so has the quadratic coefficient."""
    springs = [([1, 0], K, 2e8), ([0, 1], K, 3e8), ([-1, 1], K / 3, 1e8)]
    moved = []
    for sign in (1, -1):
        turned = [
            {"start": 1, "end": 1, "offset": [sign * i, sign * j], "stiffness": k, "quadratic": sign * q}
            for (i, j), k, q in springs
        ]
        lattice = {"cells": 4, "ends": "fixed", "strip": {"rows": 3, "kind": "cell", "masses": [M], "edges": edges}}
        lattice["strip"]["springs"] = turned
        table = {
            "lattice": lattice,
            "contacts": {"sites": []},
            "drive": {"amplitude": 2.0, "frequency": 800.0, "place": [2, 1]},
            "time": {"end": 0.02, "engine": "ts"},
        }
        moved.append(simulated(Case.from_table(table))[0]["displacement"].values)
        lattice["strip"]["springs"] = [spring | {"quadratic": 0.0} for spring in turned]
        linear = simulated(Case.from_table(table))[0]["displacement"].values
    size = np.abs(linear).max()
    assert np.abs(moved[0] - linear).max() > 0.01 * size
    np.testing.assert_allclose(moved[0], moved[1], rtol=0, atol=1e-8 * size)


CONTACTS = {"places": [[3, 2]], "law": "bilinear", "stiffness": 5 * K, "clearance": 1e-3}


ROWS = 5


def stops(engine, ends, mirrored):
    """Return a strip with stops to the ground and one between rows, rigid ones and others, or its mirror image."""

    def row(j):
        return ROWS + 1 - j if mirrored else j

    each = {
        "pair": [[0, row(1)], [row(2), row(3)], [0, row(3)], [0, row(5)]],
        "law": ["rigid", "rigid", "hertz", "rigid"],
        "restitution": [0.8, 0.5, 0.8, 0.0],
    }
    case = Case.from_table({
        "lattice": {"cells": 24, "ends": ends, "strip": {"rows": ROWS, "mass": M, "stiffness": K}},
        "contacts": {"sites": [4, 5, 6, 7], "clearance": 2e-5, "stiffness": 1e8, "each": each},
        "drive": {"amplitude": 20.0, "waveform": "harmonic", "frequency": 1000.0, "place": [3, row(2)]},
        "time": {"end": 0.04, "engine": engine},
    })  # fmt: skip
    data, result = simulated(case)
    assert result.statistics["engine"] == engine
    assert set(data["impacts/site"].values.tolist()) == {1, 2, 3, 4}
    return data["displacement"].values


@pytest.mark.parametrize("ends", ["fixed", "periodic"])
def test_a_strip_with_rows_exchanged_moves_as_the_mirror_image(ends):
    """So it does by both engines, which agree."""
    ts, propagator = (stops(engine, ends, False) for engine in ("ts", "propagator"))
    size = np.abs(ts).max()
    np.testing.assert_allclose(stops("ts", ends, True)[..., ::-1], ts, rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(stops("propagator", ends, True)[..., ::-1], propagator, rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(ts, propagator, rtol=0, atol=1e-8 * size)


def test_modes_responses_and_fits_of_a_strip(tmp_path):
    """The lowest mode and its grazing energy, the response to a force, and a clearance that is found again."""
    cells = 4
    rows = 3
    waves = [np.pi * np.arange(1, n + 1) / (n + 1) for n in (cells, rows)]
    squares = 4 * RATE**2 * np.add.outer(*(np.sin(wave / 2) ** 2 for wave in waves))
    shape = np.outer(*(np.sin(wave) for wave in waves))
    table = {"lattice": strip(rows, cells), "contacts": CONTACTS}

    # The mode grazes where the mass at (3, 2) reaches its stop.
    graze = 0.5 * M * squares[0, 0] * np.sum((1e-3 * shape / shape[2, 1]) ** 2)
    nnm = {"system": "chain", "modes": [1], "energy": [0.0, 1.05 * graze]}
    for name in ("nnm", "nfrc"):
        (tmp_path / name).mkdir()
    follow_all(NnmCase.from_table(table | {"nnm": nnm}), tmp_path / "nnm", MPI.COMM_SELF)
    with vipetsc.open(tmp_path / "nnm" / "branch-mode-1.h5") as branch:
        rest = branch["period"].values[branch["contacts"].values == 0]
        np.testing.assert_allclose(rest, 2 * np.pi / np.sqrt(squares[0, 0]), rtol=1e-9)
        at = kind_names(branch) == "grazing"
        np.testing.assert_allclose(branch["energy"].values[at], [graze], rtol=1e-6)

    # Below its clearance the response is the sum over the modes, with dashpots of 20/s to the ground.
    force, frequency = 0.05, 700.0
    drive = {"amplitude": force, "waveform": "harmonic", "frequency": frequency, "place": [2, 2]}
    nfrc = {
        "source": "force",
        "over": "amplitude",
        "range": [0.5 * force, force],
        "fixed": [frequency],
        "harmonics": 5,
        "points": 20,
    }
    table["lattice"]["damping"] = {"mass": 20.0}
    case = NfrcCase.from_table(
        table | {"drive": drive, "nfrc": nfrc, "output": {"points": [{"name": "far", "place": [4, 1]}]}}
    )
    follow_all(case, tmp_path / "nfrc", MPI.COMM_SELF)
    modes = [np.sin(np.outer(wave, np.arange(1, len(wave) + 1))) * np.sqrt(2 / (len(wave) + 1)) for wave in waves]
    moved = np.einsum("a,b,ab,a,b", modes[0][:, 1], modes[1][:, 1], 1 / (squares - frequency**2 + 20j * frequency),
                      modes[0][:, 3], modes[1][:, 0])  # fmt: skip
    (path,) = (tmp_path / "nfrc").glob("branch-*.h5")
    with vipetsc.open(path) as branch:
        assert branch["amplitude"][-1] == force
        np.testing.assert_allclose(branch["peak_displacement"][-1, 0], force / M * abs(moved), rtol=1e-6)

    # A record of a run with contacts leads back to its clearance.
    drive["amplitude"] = 60.0
    points = [{"name": "near", "place": [3, 2]}]
    run, _ = simulated(Case.from_table(table | {"drive": drive, "time": {"end": 0.06}, "output": {"points": points}}))
    assert run.sizes["episode"] > 3
    record = np.column_stack([run["time"], run["points/velocity"][:, 0]])
    np.savetxt(tmp_path / "near.csv", record, delimiter=",", header="time,near", comments="")
    sensor = {"quantity": "velocity", "column": "near", "place": [3, 2]}
    records = [{"file": str(tmp_path / "near.csv"), "time": "time", "sensors": [sensor]}]
    unknowns = [{"quantity": "clearance", "bounds": [5e-4, 2e-3]}]
    guess = table | {"contacts": CONTACTS | {"clearance": 1.2e-3}, "drive": drive}
    plan = IdentifyCase.from_table(guess | {"identify": {"records": records, "unknowns": unknowns}})
    fit = run_identification(plan, tmp_path / "fit", MPI.COMM_SELF)
    np.testing.assert_allclose(fit["value"], [1e-3], rtol=1e-6)
