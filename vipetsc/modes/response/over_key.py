"""Steady states whose parameter is a key of the case: a clearance, a restitution, a mass, a spring, a dashpot.

At each value v of the key the lattice is another one, with equations R(x, v) = 0 of its own (``steady``); amplitude and
frequency stay the same. Newton's method takes dR/dx from these equations, and dR/dv from differences of R at fixed x,
with steps of ``SLOPE`` half ranges. The differences are central, with an error of second order in the step, 1e-10. At
the two ends of the range, beyond which nothing is evaluated, they are one-sided, with an error of first order, 1e-5.
An error of this one column makes Newton's method converge linearly, with a factor of that size: it costs one more step
at an end, and does not change the solution.

A step may pass the end of the range, beyond which the key may have no valid value (a restitution above 1). The
equations are continued there by their tangent in v, and the rule of the steps replaces such a state by the one at the
end of the range (``steps.TurningSteps.end``).

At each value the case is resolved and its lattice built anew (``KeyedCase``); only what the key has not changed is
taken over.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from vipetsc.case.nfrc import NfrcCase, NfrcTable
from vipetsc.case.section import CaseError
from vipetsc.lattice import Chain, sites_at
from vipetsc.modes.balance.harmonics import ForceSeries
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.problem import FlowError, SpecialKind
from vipetsc.modes.response.condensation import contact_springs
from vipetsc.modes.response.equations import ContinuationParameter, LinearMotion, SteadyEquations
from vipetsc.modes.response.state import Measures, Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.stability import Hill, Stability

# Step of a difference in the key, over half its range.
SLOPE = 1e-5
# Values whose lattices are kept: those of a step and of its differences.
KEPT_VALUES = 9


class StatesOverKey(SteadyEquations):
    """Steady states over the key of the path ``over``, at one frequency and the ``amplitude`` of the curve.

    ``build`` gives the equations of the lattice whose key has a value; they are over the amplitude at the curve's
    frequency, and are asked at its amplitude alone. ``options`` have the range of the key.

    Unknowns (n + 1,) are over the clearance of the lattice at the lower end of the range, which is the same along the
    whole curve; those of the lattice at a value of the key ("inner") are over that lattice's own.
    """

    def __init__(self, build: Callable[[float], SteadyStates], over: str, amplitude: float, options: NfrcTable) -> None:
        self._build = build
        self._kept = BoundedCache[float, SteadyStates](KEPT_VALUES)
        low, high = options.range
        self._bounds = low, high

        first = self.states_at(low)
        super().__init__(
            options,
            balance=first.balance,
            clearance=first.clearance,
            parameter=ContinuationParameter(over, amplitude, (high - low) / 2),
        )

    def states_at(self, value: float) -> SteadyStates:
        """Return the equations of the lattice whose key has a ``value``; raises FlowError where there is none."""
        return self._kept.get(value, lambda: self._build(value))

    def linear_motion(self, omega: float) -> LinearMotion:
        """Return the motion of the linear lattice at the lower end of the range."""
        return self.states_at(self._bounds[0]).linear_motion(omega)

    def drive(self, p: float) -> tuple[float, float]:
        """Return the frequency (rad/s) and amplitude, which do not depend on the scaled parameter ``p``."""
        states = self.states_at(self._bounds[0])
        return states.parameter.fixed, self.parameter.fixed

    def shift_near(self, xi: np.ndarray) -> np.ndarray:
        """Return the stiffnesses (orders, 1, 1) in N/m that shift the compliance near the state ``xi`` (n + 1,)."""
        states, inner = self._at(xi)
        return states.shift_near(inner)

    def residual(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the residual (n,) of the harmonics, which vanishes at a steady state, over the clearance.

        Beyond the range, at the distance d from its end v, it is R(x, v) + d dR/dv(x, v).
        """
        residual = self._residual(xi, xi[-1], shift)
        beyond = xi[-1] - self._within(xi[-1])
        if beyond:
            residual = residual + beyond * self._slope(xi, shift)
        return residual

    def jacobian(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the ``residual``.

        Beyond the range the tangent of the ``residual`` changes with the motion, too; the derivative leaves that out,
        which vanishes with the distance to the range. Residual and unknowns are over the same clearance, so that the
        derivative by the motion does not depend on it.
        """
        states, inner = self._at(xi)
        return np.column_stack([states.jacobian(inner, shift)[:, :-1], self._slope(xi, shift)])

    def with_order(self, order: int) -> "StatesOverKey":
        """Return the same equations with harmonics up to another ``order``."""
        options = self.options.model_copy(update={"harmonics": order})
        over = self.parameter.over
        return StatesOverKey(lambda v: self.states_at(v).of_order(order), over, self.parameter.fixed, options)

    def truncation(self, xi: np.ndarray) -> float:
        """Return the estimated size of the harmonics that the state ``xi`` (n + 1,) leaves out, over the motion."""
        states, inner = self._at(xi)
        return states.truncation(inner)

    def _within(self, p: float) -> float:
        """Return the scaled parameter within the range that is nearest to ``p``."""
        low, high = (bound / self.parameter.scale for bound in self._bounds)
        return min(max(p, low), high)

    def _residual(self, xi: np.ndarray, p: float, shift: np.ndarray) -> np.ndarray:
        """Return residual of the motion in ``xi``, whose parameter is not used, in the lattice at the parameter ``p``.

        Beyond the range it is that at the nearest end.
        """
        states, inner = self._at(np.append(xi[:-1], p))
        return states.residual(inner, shift) * (states.clearance / self.clearance)

    def _slope(self, xi: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Return the derivative (n,) of the residual by the scaled parameter, from a difference within the range.

        An end of the range, at which one of the two places is cut off, has a one-sided difference.
        """
        after = self._within(self._within(xi[-1]) + SLOPE)
        before = self._within(self._within(xi[-1]) - SLOPE)
        difference = self._residual(xi, after, shift) - self._residual(xi, before, shift)
        return np.asarray(difference / (after - before))

    def _at(self, xi: np.ndarray) -> tuple[SteadyStates, np.ndarray]:
        """Return equations of the lattice at the key's value in ``xi`` (n + 1,), and the unknowns in their units."""
        # Rounding of p times the scale may leave the range: at its ends the value is the bound itself, which is valid.
        value = min(max(xi[-1] * self.parameter.scale, self._bounds[0]), self._bounds[1])
        states = self.states_at(float(value))
        motion = xi[:-1] * (self.clearance / states.clearance)
        return states, np.append(motion, self.parameter.fixed / states.parameter.scale)

    def from_state(self, value: float, inner: np.ndarray) -> np.ndarray:
        """Return the unknowns (n + 1,) of the state ``inner`` (n + 1,) of the lattice whose key has a ``value``."""
        motion = inner[:-1] * (self.states_at(value).clearance / self.clearance)
        return np.append(motion, value / self.parameter.scale)

    def measured(self, xi: np.ndarray, stability: Stability | None = None) -> Measures:
        """Return the measures of a state ``xi`` (n + 1,) for its file, with the value of the key among its outputs."""
        states, inner = self._at(xi)
        measures = states.measured(inner, stability)
        value = self._within(xi[-1]) * self.parameter.scale
        return measures._replace(outputs={"parameter": np.array(value), **measures.outputs})

    def special_kinds(self, left: Response, right: Response) -> Iterator[SpecialKind[Response]]:
        """Yield folds and other changes of stability within the range."""
        for kind in super().special_kinds(left, right):
            yield replace(kind, accept=self._is_within)

    def hill_at(self, xi: np.ndarray) -> tuple[Hill, ForceSeries]:
        """Return Hill's determinant of the lattice at the key's value in ``xi`` (n + 1,), and the forces there."""
        states, inner = self._at(xi)
        return states.hill_at(inner)

    def _is_within(self, point: Response) -> bool:
        """Return whether a state lies within the range, where the equations are those of a lattice."""
        return bool(self._within(point.xi[-1]) == point.xi[-1])


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
        """Return the equations at a ``value`` of the key, over the amplitude; raises FlowError for an invalid case."""
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
    """Return what makes up the linear lattice of a ``case``: its chain, and springs in N/m in the place of contacts.

    Stops, which do not belong to it, are left out, so that two can be compared.
    """
    chain = case.model().chain
    return replace(chain, sites=sites_at(chain.sites.cells, chain.sites.pairs)), contact_springs(case)
