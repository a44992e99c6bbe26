r"""Linear motion under a drive: no contact acts, and springs have their linear part alone.

With the compliance H of all masses it is u = H(Om) P, of the forces P of the drive with the amplitude a. A lattice
without contacts and nonlinear springs has no other motion: its curve is this one, on a grid. The files of other curves
have it as well, for comparison: ``linear``, the parameter, and ``linear_<quantity>`` for what they have of the states.
Contacts that are springs of the linear lattice (``condensation``) are so here, too.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from vipetsc.case.nfrc import NfrcCase
from vipetsc.io.netcdf import Variables, variable
from vipetsc.lattice import ModalCompliance, WaveCompliance, nonlinear_springs
from vipetsc.modes.response.condensation import driven_points, stops_of
from vipetsc.modes.response.outputs import HarmonicMotion, ResponseOutputs
from vipetsc.modes.response.state import Measures, Response
from vipetsc.spectra.responses import LAYOUT, LINEAR, LINEAR_OUTPUTS, OUTPUTS

# A response is that of rounding where it is so many times as large as one beside it, at a frequency that differs by
# this fraction: such a resonance would be a hundred million times as high as the motion at rest.
RESONANT = 100.0
BESIDE = 1e-6


def linear_states(
    case: NfrcCase, fixed: float, compliance: WaveCompliance | ModalCompliance, shift: float = 0.0
) -> Iterator[Response]:
    """Yield linear motions at ``nfrc.points`` values of the frequency or the amplitude, evenly spaced over the range.

    The other one of the two is ``fixed``; a force or a wall drives the lattice, whose ``compliance`` is that of
    ``compliance_of``. Frequencies are higher by the fraction ``shift``.
    """
    options = case.nfrc
    contacts = stops_of(case, 1.0)
    outputs = ResponseOutputs(case, compliance, contacts)
    weights = driven_points(case).weights
    sites = len(contacts)
    pairs = sites + len(nonlinear_springs(compliance.chain).number)
    low, high = options.range
    scale = (high - low) / 2

    for index, value in enumerate(np.linspace(low, high, options.points).tolist()):
        omega, amplitude = (value, fixed) if options.over == "frequency" else (fixed, value)
        omega *= 1 + shift
        # The mean, which is zero, and the fundamental.
        relative = np.zeros((pairs, 2), complex)
        relative[:, 1] = amplitude * compliance.response(omega)[0, :, pairs:] @ weights
        motion = HarmonicMotion(
            omega=omega,
            drive_order=1,
            amplitude=amplitude,
            relative=relative,
            forces=np.zeros_like(relative),
            driving=amplitude * weights,
            episodes=(),
        )
        measures = Measures(
            frequency=omega,
            amplitude=amplitude,
            largest=np.abs(relative[:sites, 1]),
            fractions=np.full(4, np.nan),
            unstable=0,
            growth=0.0,
            sideband=0.0,
            closed=np.zeros(sites),
            episodes=0,
            truncation=0.0,
            harmonics=relative[:sites],
            outputs=outputs.of(motion),
        )
        yield Response(xi=np.array([value / scale]), tangent=np.ones(1), index=index, measures=measures)


def resonances(states: Sequence[Response], shifted: Sequence[Response]) -> list[float]:
    """Return the frequencies in rad/s of those ``states`` in which a mode that nothing damps has its own.

    There the displacements are many times as large as those of the states ``shifted`` by ``BESIDE``.
    """
    at_resonance = []
    for state, other in zip(states, shifted, strict=True):
        size = state.measured.outputs["first_displacement"].max()
        # Also where it is no number.
        if not size <= RESONANT * other.measured.outputs["first_displacement"].max():
            at_resonance.append(state.measured.frequency)
    return at_resonance


def linear_variables(states: list[Response], over: str) -> Variables:
    """Return the ``states`` as variables of a file: the parameter ``over``, motions of sites, and outputs."""
    measured = [state.measured for state in states]
    values = np.array([getattr(measures, over) for measures in measured])
    variables = {LINEAR: variable(LINEAR, values, LAYOUT[over].units, f"{over} of linear motions")}
    for name in LINEAR_OUTPUTS:
        if name not in measured[0].outputs:
            continue
        dimensions, units, text = OUTPUTS[name]
        rows = np.array([measures.outputs[name] for measures in measured])
        variables[f"linear_{name}"] = variable((LINEAR, dimensions), rows, units, f"linear motion: {text}")
    largest = np.array([measures.largest for measures in measured])
    variables["linear_largest"] = variable((LINEAR, "site"), largest, "m", "linear motion: relative displacement")
    return variables
