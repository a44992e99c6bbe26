"""Standard errors, correlation, profiles and the best additional sensor, each compared with another computation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.conftest import run_of
from tests.identified import POINTS, identify_table, lattice_table, measured_table
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.uncertainty import marginal_jacobian, quantile, uncertainty_of
from vipetsc.io.netcdf import open_netcdf
from vipetsc.parallel import StopRequest
from vipetsc.studies.identification import Identification, read_measured_records, run_identification

UNKNOWNS = [
    {"quantity": "clearance", "of": [[1], [2]], "bounds": [1e-4, 2e-3]},
    {"quantity": "restitution", "bounds": [0.2, 1.0]},
]


def engine_derivatives(plan: IdentifyCase, z: np.ndarray, cell: int, mass: int) -> np.ndarray:
    """Derivatives (sample, parameter) of a mass's velocity in runs of the propagator, by central differences."""
    h = 1e-5
    columns = []
    for number in range(len(plan.parameters)):
        runs = []
        for sign in (-1, 1):
            moved = z.copy()
            moved[number] += sign * h
            values = [p.from_coordinate(x) for p, x in zip(plan.parameters, moved, strict=True)]
            case = plan.case_of(values).varied(output={"points": [{"name": "p", "cell": cell, "mass": mass}]})
            runs.append(run_of(case)["points/velocity"].values[:, 0])
        columns.append((runs[1] - runs[0]) / (2 * h))
    return np.column_stack(columns)


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """The plan, the coordinates (3,) found, and the results of a fit of three parameters to a record with contacts."""
    folder = tmp_path_factory.mktemp("uncertainty")
    table = lattice_table(time={"end": 0.011})
    record = measured_table(folder, table, noise=0.02)
    for sensor in record["sensors"]:
        sensor["noise"] = 0.02
    plan = IdentifyCase.from_table(identify_table(table, record, unknowns=UNKNOWNS, profile=3))
    run_identification(plan, folder / "out")
    with open_netcdf(folder / "out" / "identified.h5", "identification") as file:
        results = file.load()
    z = np.array([p.to_coordinate(v) for p, v in zip(plan.parameters, results["value"].values, strict=True)])
    return plan, z, results


def test_errors_and_correlation_are_those_of_an_engines_derivatives(identified):
    """The covariance is (J^T J)^-1 with J from differences of runs, and the sensor that is named lowers an error most.

    Another sensor adds its rows to J.
    """
    plan, z, results = identified
    rows = [engine_derivatives(plan, z, point["cell"], point["mass"]) for point in POINTS]
    jacobian = np.vstack(rows) / 0.02
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    errors = np.sqrt(np.diag(covariance))
    assert results["relative_error"].values == pytest.approx(errors, rel=1e-4)
    assert results["correlation"].values == pytest.approx(covariance / np.outer(errors, errors), abs=1e-4)
    assert results["singular"].values == pytest.approx(np.linalg.svd(jacobian, compute_uv=False), rel=1e-4)

    # The places tried are every fifth mass, and the mass that is named for the first parameter.
    named = int(results["sensor/cell"][0]), int(results["sensor/mass"][0])
    lowest = float(results["sensor/relative_error"][0])
    for cell, mass in [named, *((1 + k // 4, 1 + k % 4) for k in range(0, 24, 5))]:
        more = np.vstack([jacobian, engine_derivatives(plan, z, cell, mass) / 0.02])
        error = np.sqrt(np.linalg.inv(more.T @ more)[0, 0])
        assert error >= lowest * (1 - 1e-4)
        if (cell, mass) == named:
            assert error == pytest.approx(lowest, rel=1e-4)


def test_profiles_are_the_least_misfit_with_one_parameter_held(identified):
    """At the last value of a profile the misfit is the least one with that parameter held.

    SciPy's ``least_squares`` fits the other parameters, with differences for derivatives.
    """
    plan, z, results = identified
    misfit = Identification(plan, read_measured_records(plan), StopRequest()).windows().misfit
    ends = [float(misfit.records[0].times[-1])]
    misfit.noise = [np.full(3, 0.02)]
    least = float(np.sum(misfit.residuals(z, ends) ** 2))
    for number in (0, 2):
        place = float(results["profile/value"].values[number, 2])
        held = plan.parameters[number].to_coordinate(place)

        def residuals(others: np.ndarray, number: int = number, held: float = held) -> np.ndarray:
            return misfit.residuals(np.insert(others, number, held), ends)

        fitted = least_squares(residuals, np.delete(z, number), method="lm", x_scale=1e-3)
        assert results["profile/cost"].values[number, 2] == pytest.approx(2 * fitted.cost - least, rel=2e-2)
        # In a linear problem the sum of squares grows by 3^2 at three standard errors.
        assert 5 < results["profile/cost"].values[number, 2] < 15
    assert results["profile/cost"].values[:, 1] == pytest.approx(0, abs=1e-6)


def test_the_marginal_jacobian_has_the_inverse_of_the_covariance():
    """The marginal Jacobian A has (A^T A)^-1 equal to the parameters' block of the covariance of all coordinates."""
    jacobian = np.random.default_rng(2).standard_normal((30, 7))
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    marginal = marginal_jacobian(jacobian, 3)
    assert np.linalg.inv(marginal.T @ marginal) == pytest.approx(covariance[:3, :3], rel=1e-10)
    assert uncertainty_of(marginal).errors == pytest.approx(uncertainty_of(jacobian).errors[:3], rel=1e-10)


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.99])
def test_intervals_of_few_data_are_as_wide_as_their_noise_is_uncertain(confidence):
    """Intervals of a straight line through six points with estimated noise hold the truth as often as they state."""
    generator = np.random.default_rng(6)
    jacobian = np.column_stack([np.ones(6), np.linspace(-1, 1, 6)])
    noise = generator.standard_normal((40_000, 6))
    found = noise @ np.linalg.pinv(jacobian).T
    # Four degrees of freedom are left to the noise.
    estimated = np.sqrt(np.sum((noise - found @ jacobian.T) ** 2, axis=1) / 4)
    error = uncertainty_of(jacobian).errors[1] * estimated
    held = np.abs(found[:, 1]) < quantile(confidence, 4) * error
    assert np.mean(held) == pytest.approx(confidence, abs=0.01)


@pytest.mark.parametrize("given", [False, True])
def test_a_value_at_its_bound_has_no_interval(tmp_path, given):
    """A fit that wants a value beyond a bound says so; the interval of the others has the noise that is known."""
    table = lattice_table(time={"end": 0.009})
    record = measured_table(tmp_path, table, noise=0.01)
    if given:
        for sensor in record["sensors"]:
            sensor["noise"] = 0.01
    unknowns = [
        {"quantity": "clearance", "bounds": [5.3e-4, 8e-4], "of": [[1]]},
        {"quantity": "restitution", "bounds": [0.2, 1.0]},
    ]
    run_identification(IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns)), tmp_path / "out")
    with open_netcdf(tmp_path / "out" / "identified.h5", "identification") as file:
        found = file.load()
    assert found["at_bound"].values.tolist() == [-1, 0]
    assert found["value"].values[0] == pytest.approx(5.3e-4, rel=1e-3)
    assert np.isnan(found["interval_low"].values[0])
    assert "lower bound" in found.attrs["warnings"]
    assert "at its bound" in found.attrs["summary"]

    freedom = np.inf
    if not given:
        freedom = found.sizes["datum"] - 2
    width = (found["interval_high"] - found["interval_low"]).values[1]
    assert width == pytest.approx(2 * quantile(0.9, freedom) * found["standard_error"].values[1], rel=1e-6)
