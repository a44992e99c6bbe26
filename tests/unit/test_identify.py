"""The section [identify]: every problem of data and unknowns with its key, value and remedy; parameters and cases."""

from __future__ import annotations

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import xarray as xr

from tests.identified import identify_table, lattice_table
from vipetsc.case import Case, CaseError
from vipetsc.case.identify import IdentifyCase, RecordTable, read_measured
from vipetsc.studies.identified import _start_values, few_samples

SENSOR = {"quantity": "velocity", "column": "v", "cell": 2, "mass": 1}


def record_in(path, **changes):
    """Return the table of a record in ``path``."""
    return {"file": str(path), "time": "t", "sensors": [SENSOR]} | changes


def written(folder, rows=None, names="t,v"):
    """Write a record of 20 samples, or of ``rows``, as a table of text, and return its path."""
    path = folder / "record.csv"
    if rows is None:
        rows = [f"{1e-3 * k:.4f},{np.sin(k):.6f}" for k in range(20)]
    path.write_text("\n".join([names, *rows]) + "\n", encoding="utf-8")
    return path


def problems_of(record, **options):
    """Return the problems of an identification with one ``record``, by key."""
    with pytest.raises(CaseError) as caught:
        IdentifyCase.from_table(identify_table(lattice_table(), record, **options))
    return {problem.key: f"{problem.value}: {problem.remedy}" for problem in caught.value.problems}


def rows_with(index, row):
    """Return the rows of a record, with another one at ``index``."""
    rows = [f"{1e-3 * k:.4f},{np.sin(k):.6f}" for k in range(20)]
    rows[index] = row
    return rows


@pytest.mark.parametrize(
    ("rows", "key", "part"),
    [
        (rows_with(7, "0.0070,nan"), "sensors[1].column", "sample 8 of 20 is not a finite number"),
        (rows_with(7, "0.0070,"), "file", "line 9 has another number of fields"),
        (rows_with(7, "0.0074,1.0"), "time", "uneven: sample 8 is at 0.0074 s instead of 0.007 s"),
        (["0.0,1.0"] * 20, "time", "must rise"),
        ([f"{1e-3 * k},0.0" for k in range(20)], "sensors[1].column", "zero at all times"),
        ([], "file", "has no line of numbers"),
    ],
)
def test_bad_data_are_one_clear_error(tmp_path, rows, key, part):
    problems = problems_of(record_in(written(tmp_path, rows)))
    # One bad row is one problem.
    assert list(problems) == [f"identify.records[1].{key}"]
    assert part in problems[f"identify.records[1].{key}"]


@pytest.mark.parametrize(
    ("changes", "key", "part"),
    [
        ({"sensors": [SENSOR | {"cell": 7}]}, "sensors[1].cell", "the lattice has the cells 1 to 6"),
        ({"sensors": [SENSOR | {"mass": 5}]}, "sensors[1].mass", "a cell has the masses 1 to 4"),
        ({"sensors": [SENSOR | {"column": "w"}]}, "sensors[1].column", "no column of that name; there are t, v"),
        ({"sensors": [SENSOR | {"quantity": "force"}]}, "sensors[1].cell", "use drive in place of cell"),
        ({"rate": 1e3}, "time", "one of both"),
        ({"begin": 0.005, "end": 0.01}, "end", "leaves 6 samples"),
        ({"initial": {"kind": "velocity", "cell": 9, "velocity": 1.0}}, "initial.cell", "outside the lattice"),
        (
            {"initial": "estimate", "sensors": [{"quantity": "force", "column": "v"}]},
            "initial",
            "needs a sensor of motion",
        ),
        ({"offset": [1.0, 0.0]}, "offset", "low below high"),
    ],
)
def test_keys_of_a_record_are_checked(tmp_path, changes, key, part):
    problems = problems_of(record_in(written(tmp_path)) | changes)
    assert part in problems[f"identify.records[1].{key}"]


@pytest.mark.parametrize(
    ("unknown", "key", "part"),
    [
        ({"quantity": "exponent", "bounds": [1.0, 2.0]}, "quantity", 'only the law "power" has an exponent'),
        ({"quantity": "clearance", "bounds": [-1.0, 1.0]}, "bounds", "must be positive"),
        ({"quantity": "cubic", "bounds": [-1.0, 1.0], "scale": "logarithmic"}, "bounds", "must be positive"),
        ({"quantity": "restitution", "bounds": [0.5, 1.2]}, "bounds", "between 0 and 1"),
        ({"quantity": "clearance", "bounds": [1e-5, 1.0], "of": [[4]]}, "of", "from 1 to 3"),
        ({"quantity": "clearance", "bounds": [1e-5, 1.0], "of": [[1], [1, 2]]}, "of", "sought twice"),
        ({"quantity": "clearance", "bounds": [1e-5, 1.0], "start": [1e-3, 1e-3]}, "start", "each of the 1 values"),
        ({"quantity": "clearance", "bounds": [1e-5, 1e-4], "start": 1e-3}, "start", "within the bounds"),
        ({"quantity": "dashpot", "bounds": [1e-3, 1.0]}, "start", "springs without a dashpot"),
        ({"quantity": "dashpot", "bounds": [-1.0, 1.0], "scale": "linear", "start": 0.5}, "bounds", "not be negative"),
        ({"quantity": "clearance_minus", "bounds": [1e-3, 1.0]}, "quantity", "set contacts.clearance_minus"),
    ],
)
def test_unknowns_are_checked(tmp_path, unknown, key, part):
    problems = problems_of(record_in(written(tmp_path)), unknowns=[unknown])
    assert part in problems[f"identify.unknowns[1].{key}"]


def test_a_table_and_an_hdf5_file_give_the_same_record(tmp_path):
    """Columns by name or number, with comments, semicolons, decimal commas, factors or a rate, and datasets of one or
    two dimensions yield the same times and values.
    """
    times = 1e-3 * np.arange(20)
    values = np.sin(np.arange(20.0))
    text = tmp_path / "r.csv"
    lines = [
        "# a comment",
        "time (ms);v (g)",
        *(f"{1e3 * t:.17g};{v:.17g}" for t, v in zip(times, values, strict=True)),
    ]
    text.write_text("\n".join(lines))
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["clock"] = times
        file["points/velocity"] = np.column_stack([0 * values, values])

    scaled = [SENSOR | {"column": "v (g)", "factor": 9.81}]
    by_name = {"file": str(text), "time": "time (ms)", "time_factor": 1e-3, "sensors": scaled}
    by_number = {"file": str(text), "rate": 1e3, "sensors": [SENSOR | {"column": 2, "factor": 9.81}]}
    dataset = [SENSOR | {"column": "points/velocity[2]", "factor": 9.81}]
    in_hdf5 = {"file": str(tmp_path / "r.h5"), "time": "clock", "sensors": dataset}
    for record in (by_name, by_number, in_hdf5):
        measured = read_measured(RecordTable.model_validate(record))
        assert measured.times == pytest.approx(times, abs=1e-15)
        assert measured.values[:, 0] == pytest.approx(9.81 * values, rel=1e-12)

    decimals = [f"{1e3 * t:.17g};{v:.17g}".replace(".", ",") for t, v in zip(times, values, strict=True)]
    text.write_text("\n".join(["time (ms);v (g)", *decimals]))
    with_commas = read_measured(RecordTable.model_validate(by_name))
    assert with_commas.values[:, 0] == pytest.approx(9.81 * values, rel=1e-12)
    text.write_text("\n".join(decimals))
    assert read_measured(RecordTable.model_validate(by_number)).values[0, 0] == pytest.approx(9.81 * values[0])
    text.write_text("\n".join(lines))
    cut = read_measured(RecordTable.model_validate(by_name | {"begin": 0.002, "end": 0.01}))
    assert cut.times == pytest.approx(1e-3 * np.arange(2, 11))


def test_parameters_go_into_the_case(tmp_path):
    """Sites of a group get one value, others keep theirs, and the resulting case can be written and read again."""
    unknowns = [
        {"quantity": "clearance", "of": [[1, 3]], "bounds": [1e-5, 1e-2]},
        {"quantity": "restitution", "of": "each", "bounds": [0.1, 1.0]},
        {"quantity": "mass", "of": [[2]], "bounds": [1e-5, 1.0]},
        {"quantity": "dashpot", "of": [[1]], "bounds": [1e-5, 1.0], "start": 0.1},
        {"quantity": "amplitude", "bounds": [1.0, 100.0]},
    ]
    record = record_in(written(tmp_path), offset=[-1e-3, 1e-3])
    plan = IdentifyCase.from_table(identify_table(lattice_table(), record, unknowns=unknowns))
    names = [parameter.name for parameter in plan.parameters]
    assert names == [
        "clearance 1+3",
        *(f"restitution {number}" for number in (1, 2, 3)),
        "mass 2",
        "dashpot 1",
        "amplitude",
        "offset",
    ]

    case = plan.case_of([7e-4, 0.5, 0.6, 0.8, 0.003, 0.2, 33.0, 5e-4])
    chain = case.model().chain
    assert chain.sites.clearances.tolist() == [7e-4, 4e-4, 7e-4]
    assert [site.law.restitution for site in case.model().chain.sites] == [0.5, 0.6, 0.8]
    assert chain.cell.masses[1] == 0.003
    assert [spring.damping for spring in chain.cell.springs][:2] == [0.2, 0.0]
    assert case.drive.amplitude == 33.0
    # The drive of the measurement keeps its frequency, although a mass and hence the bands have changed.
    assert case.drive.frequency == plan.base.drive.frequency
    assert Case.from_toml(case.to_toml()) == case

    again = IdentifyCase.from_toml(plan.to_toml())
    assert again.to_toml() == plan.to_toml()
    assert again.options.records[0].sha256


def test_sides_and_dashpots_to_the_ground_go_into_the_case(tmp_path):
    """Clearances on the side w < 0, of some sites or of all, and dashpots to the ground go into the case."""
    base = lattice_table(contacts={"clearance_minus": 9e-4})
    record = record_in(written(tmp_path))
    bounds = {"bounds": [1e-5, 1e-2], "start": 1e-3}
    unknowns = [
        {"quantity": "clearance_minus", "of": [[1, 2]]} | bounds,
        {"quantity": "grounding", "of": [[3]]} | bounds,
    ]
    plan = IdentifyCase.from_table(identify_table(base, record, unknowns=unknowns))
    assert [parameter.name for parameter in plan.parameters] == ["clearance_minus 1+2", "grounding 3"]
    # Values that neither the case nor the start has.
    model = plan.case_of([7e-4, 2e-3]).model()
    assert model.chain.sites.gaps.tolist() == [[5e-4, 7e-4], [4e-4, 7e-4], [3e-4, 9e-4]]
    assert model.chain.cell.grounding == (0.0, 0.0, 2e-3, 0.0)

    unknowns = [{"quantity": "clearance_minus"} | bounds]
    plan = IdentifyCase.from_table(identify_table(base, record, unknowns=unknowns))
    assert plan.case_of([7e-4]).model().chain.sites.gaps.tolist() == [[5e-4, 7e-4], [4e-4, 7e-4], [3e-4, 7e-4]]


def test_coordinates_and_values_are_inverse(tmp_path):
    """A parameter's value and coordinate are inverse maps, whose derivative agrees with central differences."""
    plan = IdentifyCase.from_table(identify_table(lattice_table(), record_in(written(tmp_path))))
    for parameter in plan.parameters:
        z = parameter.to_coordinate(parameter.start)
        assert parameter.from_coordinate(z) == pytest.approx(parameter.start)
        # Coordinates are of order one: the error of central differences, h^2, is below the tolerance.
        h = 1e-6
        slope = (parameter.from_coordinate(z + h) - parameter.from_coordinate(z - h)) / (2 * h)
        assert parameter.slope(z) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(("error", "valleys"), [(0.1, [2, 1, 0, 1]), (0.03, [3, 1, 0, 2])])
def test_starts_are_numbered_by_valley_from_the_deepest(error, valleys):
    """Fits within three standard errors of a bottom lie in its valley; a start that failed lies in none."""
    fits = []
    for coordinate, deviance in ((5.0, 40.0), (1.0, 10.0), (None, None), (1.25, 11.0)):
        fit = {"begin": [0.1 * deviance] if deviance else None, "coordinates": [coordinate], "deviance": deviance}
        fits.append({"reason": "stuck"} if coordinate is None else fit)
    plan = SimpleNamespace(options=SimpleNamespace(starts=4))
    misfit = SimpleNamespace(plan=plan, values=lambda z: 10 * z)
    windows = SimpleNamespace(misfit=misfit, low=np.zeros(1))

    values = _start_values(windows, fits, best=1, errors=np.array([error]))
    assert values["starts/valley"].tolist() == valleys
    assert values["starts/value"][:, 0] == pytest.approx([50.0, 10.0, np.nan, 12.5], nan_ok=True)
    assert values["starts/begin"][:, 0] == pytest.approx([40.0, 10.0, np.nan, 11.0], nan_ok=True)
    assert values["starts/deviance"] == pytest.approx([30.0, 0.0, np.nan, 1.0], nan_ok=True)


def test_the_force_of_a_moved_wall_is_no_sensor(tmp_path):
    """A force sensor is accepted for a driving force and refused for a moved wall.

    A moved wall acts by a stiffness times its motion, which no load cell measures.
    """
    sensors = [SENSOR, {"quantity": "force", "column": "v"}]
    wall = {"waveform": "harmonic", "end": "left", "amplitude": 1e-4, "frequency": 300.0}
    record = record_in(written(tmp_path), sensors=sensors)
    IdentifyCase.from_table(identify_table(lattice_table(), record))

    with pytest.raises(CaseError) as caught:
        IdentifyCase.from_table(identify_table(lattice_table() | {"drive": wall}, record))
    (problem,) = caught.value.problems
    assert problem.key == "identify.records[1].sensors[2].quantity"
    assert "drive 1 moves a wall" in problem.remedy


@pytest.mark.parametrize(("outliers", "is_said"), [(0, False), (1, True), (3, True), (10, True), (40, False)])
def test_a_misfit_of_few_samples_is_said(outliers, is_said):
    """Samples within an impact that the model has of another duration make the misfit, and the others the noise."""
    residuals = 2e-3 * np.random.default_rng(1).standard_normal(200)
    residuals[100 : 100 + outliers] = 0.9
    data = xr.Dataset(
        {
            "data/channel": ("datum", np.zeros(200, int)),
            "data/time": ("datum", 1e-5 * np.arange(200)),
            "data/measured": ("datum", np.zeros(200)),
            "data/model": ("datum", residuals),
            "channels/unit": ("channel", ["m/s"]),
        }
    )
    sentences = list(few_samples(data, "near"))
    assert len(sentences) == is_said
    if is_said:
        assert all(word in sentences[0] for word in (f"{outliers} sample", "between 0.001 and"))
