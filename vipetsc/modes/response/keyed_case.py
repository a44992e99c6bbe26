"""A case whose key varies along a curve: the equations of its lattice at each value.

At each value the case is resolved and its lattice built anew; only what the key has not changed is taken over.
"""

from dataclasses import replace

from vipetsc.case.case_file import CaseError
from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import Chain
from vipetsc.modes.problem import FlowError
from vipetsc.modes.response.condensation import contact_springs
from vipetsc.modes.response.steady import SteadyStates


class KeyedCase:
    """The lattices of a ``case`` over its key ``nfrc.over``, with a ``restitution`` and an ``amplitude``.

    Most keys of ``[contacts]`` leave the linear lattice as it is, and what is computed of it serves all their values.
    It has springs in the place of contacts that alone hold it, whose stiffnesses follow from the law and the
    precompression. ``amplitude`` is in the unit of the drive (``NfrcTable``).
    """

    def __init__(self, case: NfrcCase, restitution: float, amplitude: float) -> None:
        self.case = case
        self.restitution = restitution
        self.amplitude = amplitude
        self._last: SteadyStates | None = None

    def at(self, value: float) -> SteadyStates:
        """The equations at a ``value`` of the key, over the amplitude; raises FlowError where the case is invalid."""
        key = self.case.nfrc.over
        try:
            case = self.case.at(value, self.amplitude)
        except CaseError as error:
            reasons = "; ".join(map(str, error.problems))
            raise FlowError(f"no lattice with {key} = {value:.6g}: {reasons}") from None

        restitution = self.restitution
        if key == "contacts.restitution":
            restitution = value
        like = None
        if self._last is not None and _linear_lattice(self._last.case) == _linear_lattice(case):
            like = self._last
        self._last = SteadyStates(case, restitution, case.nfrc.fixed[0], like=like)
        return self._last


def _linear_lattice(case: NfrcCase) -> tuple[Chain, tuple[float, ...]]:
    """What makes up the linear lattice of a ``case``: its chain, and springs in N/m in the place of contacts.

    Clearances, which do not belong to it, are left out, so that two can be compared.
    """
    return replace(case.model().chain, clearances=()), contact_springs(case)
