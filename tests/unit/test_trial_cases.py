"""Trial cases of an identification have the bits of the same cases read from their tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import with_sections
from tests.identified import lattice_table
from vipetsc.case import Case, CaseError
from vipetsc.case.identify import SoughtParameter, TrialCases, UnknownTable, parameters_of, values_of
from vipetsc.case.quantities import QUANTITIES

CELL = {
    "masses": [0.01, 0.02],
    "springs": [
        {"start": 2, "end": 1, "stiffness": 2e4, "next_cell": True, "damping": 0.1, "quadratic": 1e5},
        {"start": 1, "end": 2, "stiffness": 1e4, "cubic": 1e8},
    ],
    "grounding": [0.1, 0.0],
}
POWER = {"law": "power", "exponent": 1.4, "stiffness": 2e6}
AT_REST = {"amplitude": 0.0, "cycles": None}
CASES: dict[str, dict[str, Any]] = {
    "preset": {},
    "two sides": {"contacts": {"clearance_minus": 6e-4}},
    "own cell": {"lattice": {"preset": None, "cell": CELL}, "drive": {"frequency": 900.0}},
    "lists over sites": {
        "contacts": {"stiffness": None, "each": {"restitution": [0.7, 0.8, 0.9], "stiffness": [1e6, 2e6, 3e6]}}
    },
    "proportional dashpots": {"lattice": {"damping": {"mass": 1.0, "stiffness": 1e-6}}},
    "loss of a band": {"lattice": {"damping": {"loss": {"2": 0.02}}}},
    "struck": {"drive": AT_REST, "initial": {"kind": "velocity", "cell": 2, "velocity": 0.5}},
    "mode": {"drive": AT_REST, "initial": {"kind": "mode", "number": 3, "energy": 1e-4}},
    "wall": {"drive": {"waveform": "harmonic", "end": "left", "amplitude": 1e-4, "cycles": None, "frequency": 500.0}},
}
RECORDS: dict[str, dict[str, Any]] = {
    "as the case": {},
    "another drive": {"drive": {"cycles": 3, "frequency": 800.0}},
    "an amplitude of its own": {"drive": {"amplitude": 5.0}},
    "a mode of an energy": {"initial": {"kind": "mode", "number": 3, "energy": 1e-4}},
}


def quantities_of(name: str) -> list[str]:
    """Return the quantities that can be sought in the case of that ``name`` in ``CASES``."""
    missing = set()
    # The clearance on the side w < 0 is sought where the case has one.
    if name != "two sides":
        missing.add("clearance_minus")
    # A case without a drive has no numbers of one.
    if CASES[name].get("drive") is AT_REST:
        missing |= {quantity for quantity in QUANTITIES if QUANTITIES[quantity].of == "drive"}
    # Springs to a moved wall must be linear and without dashpots.
    if name == "wall":
        missing |= {"dashpot", "quadratic", "cubic"}
    return [quantity for quantity in QUANTITIES if quantity not in missing]


def base_of(name: str) -> Case:
    """Return the case of that ``name`` in ``CASES``, with a power law."""
    table = with_sections(lattice_table(contacts=POWER), CASES[name])
    for section in ("lattice", "contacts", "drive"):
        table[section] = {key: value for key, value in table[section].items() if value is not None}
    return Case.from_table(table)


def sought(base: Case, quantity: str, of: str) -> list[SoughtParameter]:
    """Return the parameters of an unknown with wide bounds."""
    unknown = UnknownTable(quantity=quantity, of=of, bounds=[-1e30, 1e30], scale="linear")  # type: ignore[arg-type]
    return parameters_of(unknown, base)


def assert_same(trials: TrialCases, values: list[float]) -> None:
    """Assert that a trial case and the case that is read have the same text and model, to the bit."""
    cheap = trials.case(values)
    read = trials.read(values)
    assert cheap.to_toml() == read.to_toml()
    assert cheap == read
    assert cheap.model() == read.model()


def trial_values(base: Case, parameters: list[SoughtParameter], factor: float) -> list[float]:
    """Return values that are ``factor`` times those of the ``base``, all different, and small where it has zeros."""
    values = []
    for number, parameter in enumerate(parameters):
        start = np.mean([values_of(base, parameter.quantity)[member] for member in parameter.members])
        values.append(float(start or 1e-3) * factor * (1 - 0.01 * number))
    return values


@pytest.mark.parametrize(("name", "quantity"), [(name, quantity) for name in CASES for quantity in quantities_of(name)])
def test_trial_cases_are_those_that_are_read(name, quantity):
    """The second trial of a quantity, which is not read from a table, has the bits of the case that is read."""
    base = base_of(name)
    # Reading a cell computes its bands, which takes time: one common value is tried for the preset alone.
    for of in ("all", "each") if name == "preset" else ("each",):
        parameters = sought(base, quantity, of)
        trials = TrialCases(base, parameters, {})
        trials.case(trial_values(base, parameters, factor=0.98))
        assert_same(trials, trial_values(base, parameters, factor=1.02))


@pytest.mark.parametrize("record", RECORDS)
def test_trial_cases_of_records_are_those_that_are_read(record):
    """Trial cases of several quantities, with the drive and initial motion of a record, are those that are read."""
    base = base_of("two sides")
    quantities = ("clearance", "restitution", "mass", "spring", "amplitude")
    parameters = [parameter for quantity in quantities for parameter in sought(base, quantity, "all")]
    trials = TrialCases(base, parameters, RECORDS[record])
    trials.case(trial_values(base, parameters, factor=0.98))
    assert_same(trials, trial_values(base, parameters, factor=1.02))


@pytest.mark.parametrize(
    ("name", "contacts", "quantity", "valid", "wrong"),
    [
        ("wall", {}, "quadratic", 0.0, 1e5),
        ("preset", {"damping": "flores"}, "restitution", 0.9, 1e-9),
        ("preset", {"precompression": 1e-4, "side": "plus"}, "clearance", 2e-4, 5e-5),
    ],
)
def test_impossible_trial_cases_are_refused_as_those_that_are_read(name, contacts, quantity, valid, wrong):
    """An impossible trial has the problems of the case that is read from its table."""
    base = base_of(name)
    if contacts:
        base = base.varied(contacts=contacts | {"restitution": 0.9})
    trials = TrialCases(base, sought(base, quantity, "all"), {})
    trials.case([valid])
    with pytest.raises(CaseError) as cheap:
        trials.case([wrong])
    with pytest.raises(CaseError) as read:
        trials.read([wrong])
    assert [problem.key for problem in cheap.value.problems] == [problem.key for problem in read.value.problems]


def test_a_lattice_may_come_out_too_fast_for_the_samples_of_the_case():
    """A mass too light for the sample interval of the case is accepted, since samples are those of the measurement."""
    base = base_of("preset").varied(time={"sample_interval": 8e-4})
    mass = values_of(base, "mass")[0]
    trials = TrialCases(base, sought(base, "mass", "all"), {})
    trials.case([mass])
    assert trials.case([0.5 * mass]).lattice.unit_cell().masses == (0.5 * mass,) * 4
    found = trials.read([0.5 * mass])
    assert found.time.sample_interval < 8e-4
