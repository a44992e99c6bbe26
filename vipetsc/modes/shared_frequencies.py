"""Linear modes at which no branch can begin: another mode has the same frequency, or a multiple of it.

Small motions in which both modes take part are then periodic with the period of the first one. The orbits of this
period form a surface and not a curve, and the mode does not determine which of them continues when a contact begins to
act. In a ring of equal cells the waves to the left and to the right have one frequency, so that nearly all modes come
in pairs.
"""

from typing import NamedTuple

from vipetsc.case import CaseError, NnmCase, Problem
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.system import System

# Squared frequencies are equal within this fraction, or within rounding of the largest one in the eigenvalues. In
# lattices of 240 built-in cells (960 modes) those of equal modes differ by 1e-11 at most, all others by 5e-7 at least.
SAME = 1e-10
ROUNDING = 1e-13
# Largest number of masses for which modes are compared before a command computes anything; it takes a second at most.
MOST_COMPARED = 1000
REMEDY = (
    "choose modes with a frequency of their own (nnm.modes), or make the system less symmetric: cells that differ "
    '(lattice.profiles, lattice.scatter), ends = "fixed" or "free", other masses'
)


class Companion(NamedTuple):
    """Another ``mode``, from 0, whose frequency is this ``multiple`` of the one that is asked for."""

    mode: int
    multiple: int


def companions(system: System, mode: int) -> list[Companion]:
    """Return the other modes of ``system`` whose motion is periodic with the period of ``mode`` (from 0).

    Branches of an odd system are sought among motions with u(t + T/2) = -u(t), in which modes of even multiples take no
    part.
    """
    omega, _ = system.linear_modes()
    rounding = ROUNDING * omega[-1] ** 2
    lowest = omega[mode]
    if not lowest**2 > rounding:
        return []

    shared = []
    for other, frequency in enumerate(omega.tolist()):
        multiple = round(frequency / lowest)
        is_near = abs(frequency**2 - (multiple * lowest) ** 2) <= SAME * frequency**2 + rounding
        takes_part = multiple > 0 and (multiple % 2 == 1 or not system.odd)
        if other != mode and is_near and takes_part:
            shared.append(Companion(other, multiple))
    return shared


def why_not_alone(system: System, mode: int) -> str:
    """Return why no branch begins with ``mode`` (from 0) alone, and the remedy; empty where one does.

    It is empty, too, for systems that are not linear about rest (smooth springs, pressed contacts of Hertz's law):
    their small motions depend on the nonlinearity, and Newton's method finds a branch or fails.
    """
    if not system.is_linear_at_rest:
        return ""
    shared = companions(system, mode)
    if not shared:
        return ""
    number = mode + 1
    equal = [str(companion.mode + 1) for companion in shared if companion.multiple == 1]
    if equal:
        others = ", ".join(equal)
        return f"mode {number} has the frequency of mode {others}: any mixture of these is a mode, too; {REMEDY}"
    first = shared[0]
    return (
        f"mode {first.mode + 1} has {first.multiple} times the frequency of mode {number}: small motions of both "
        f"together are periodic, too; {REMEDY}"
    )


def check_start(system: System, mode: int, energy: float) -> None:
    """Raise ContinuationError if no branch begins with ``mode`` (from 0) alone at a start ``energy`` in J.

    Beyond the energy at which the mode touches a contact its motion is not linear, and nothing is checked.
    """
    if energy < system.grazing_energy(mode):
        reason = why_not_alone(system, mode)
        if reason:
            raise ContinuationError(reason)


def check_modes_alone(case: NnmCase) -> None:
    """Raise CaseError if a mode of the ``case`` shares its frequency with another one.

    Lattices with more than ``MOST_COMPARED`` masses are left to ``check_start``, by which the branch fails instead.
    """
    if case.nnm.start_frequency or case.nnm.system == "condensed":
        return
    system = System.from_case(case)
    if system.dofs > MOST_COMPARED:
        return
    reasons = {mode: why_not_alone(system, mode - 1) for mode in case.nnm.modes}
    problems = [Problem("nnm.modes", [mode], reason) for mode, reason in reasons.items() if reason]
    if problems:
        raise CaseError(problems, case.name)
