"""Frequency responses to several drives of one frequency: superposition, time integration and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.conftest import with_sections
from tests.rigs import OUTPUT, TWO_MASSES
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

FORCE = {"waveform": "harmonic", "amplitude": 0.3, "frequency": 1.0, "cell": 1}
# A negative amplitude acts in antiphase.
BEYOND = {"waveform": "harmonic", "amplitude": -0.6, "frequency": 1.0, "cell": 2}
LEFT = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "end": "left"}
RIGHT = LEFT | {"end": "right", "amplitude": 0.25}


def rig(*drives: dict[str, Any], **nfrc: Any) -> NfrcCase:
    """The case of two masses with ``drives``; its curve is at the amplitude of the first one."""
    first, *more = drives
    # The amplitude of a curve is positive; the sign of the drive's is a phase.
    table = with_sections(TWO_MASSES, {"nfrc": {"fixed": [abs(first["amplitude"])]} | nfrc})
    return NfrcCase.from_table(table | {"drive": first | ({"more": more} if more else {}), "output": OUTPUT})


def states_of(case: NfrcCase) -> SteadyStates:
    """The steady states of the first curve of a case."""
    _, restitution, fixed = case.curves()[0]
    return SteadyStates(case, restitution, fixed)


def phasors(outputs: dict[str, np.ndarray]) -> np.ndarray:
    """Complex first harmonics (4,) of the displacements of both masses in m, and of the forces on both walls in N."""
    displacement = outputs["location_harmonics"][:, 1] + 1j * outputs["location_harmonics_imaginary"][:, 1]
    return np.append(displacement, outputs["first_wall_force"] * np.exp(-1j * np.radians(outputs["wall_force_lag"])))


def linear_phasors(*drives: dict[str, Any]) -> np.ndarray:
    """The ``phasors`` at 1.3 rad/s of the linear state under ``drives``, with a stop out of reach."""
    case = rig(*drives, range=[1.3, 2.0])
    states = states_of(NfrcCase.from_table(case.model_dump(by_alias=True, exclude_none=True) | FAR))
    return phasors(states.measured(first_state(states).xi).outputs)


# A stop that is out of reach, so that states are linear.
FAR = {"contacts": TWO_MASSES["contacts"] | {"clearance": 1e3}}


@pytest.mark.parametrize(
    "drives",
    [(FORCE, BEYOND), (LEFT, RIGHT), (LEFT, FORCE), (BEYOND, LEFT, RIGHT)],
    ids=["forces", "walls", "mixed", "3"],
)
def test_without_contact_drives_are_superposed(drives):
    """Without contact, displacements and wall forces are sums of those under each drive alone, at its own amplitude."""
    together = linear_phasors(*drives)
    alone = sum(np.sign(drive["amplitude"]) * linear_phasors(drive) for drive in drives)
    # Phases are relative to the first drive, whose sign therefore changes all signs.
    np.testing.assert_allclose(together * np.sign(drives[0]["amplitude"]), alone, rtol=1e-9)


def test_two_forces_on_one_mass_are_one():
    """Two halves of a force act as the whole force, also with contact, in every unknown of the state."""
    half = FORCE | {"amplitude": 0.5}
    whole = first_state(states_of(rig(FORCE | {"amplitude": 1.0}, range=[1.4, 2.0], harmonics=15)))
    halves = first_state(states_of(rig(half, half, range=[1.4, 2.0], harmonics=15)))
    assert abs(whole.xi[:-1]).max() > 1.05  # clearances: the state is in contact
    np.testing.assert_allclose(halves.xi, whole.xi, atol=1e-10)
