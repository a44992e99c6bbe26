"""Steps along a curve of steady states, where it begins, and where it ends.

A curve begins at the lower end of its range. Where the linear motion touches no contact, it is the state there. Else
the state is reached by a homotopy from the linear motion: growing amplitudes, or growing weights of the contacts'
forces. Both are curves themselves, followed by the same continuation; of several states at the lower end only the one
to which they lead is found.
"""

from dataclasses import replace

import numpy as np

from vipetsc.endings import Ended, Ending
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.continuation.arclength import Continuation, Verdict
from vipetsc.modes.problem import Attempt, ContinuationError
from vipetsc.modes.response.over_key import StatesOverKey
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.turning import BoundedTurn
from vipetsc.parallel import StoppedError, StopRequest

# Largest number of states on growing amplitudes to the beginning of a range. Where the case asks for short steps, as
# many are allowed as cover this arclength.
MOST_RAMP = 300
LONGEST_RAMP = 30.0
# States on growing weights of the contacts' forces, at most.
MOST_WEIGHTS = 10_000


class TurningSteps(BoundedTurn):
    """The step rule of steady states (``StepRule``): a bounded turn, and an end on the curve's range.

    Lengths of steps are those of [nfrc], in units of the unknowns; ``points`` is the largest number of states. An
    isolated curve also ends where it comes back to its ``first`` state.
    """

    points_key = "nfrc.points"
    problem: SteadyStates | StatesOverKey

    def __init__(self, states: SteadyStates | StatesOverKey, points: int, first: Response | None = None) -> None:
        options = states.options
        super().__init__(states, points, np.array(options.range) / states.parameter.scale, first)
        self.first_step = options.first_step
        self.smallest_step = options.smallest_step
        self.largest_step = options.largest_step

    def ended_at(self, bound: float) -> Ended:
        """Return that the parameter came to an end of its range."""
        return Ending.END_OF_RANGE.with_numbers(end=bound * self.problem.parameter.scale)

    def stuck(self, last: Response, attempt: Attempt | None, verdict: Verdict) -> str:
        """Return the message where and why the curve cannot go on, and which key to change."""
        states = self.problem
        omega, amplitude = states.drive(last.xi[-1])
        at = f"{omega:.8g} rad/s at amplitude {amplitude:.6g}"
        if isinstance(states, StatesOverKey):
            value = last.xi[-1] * states.parameter.scale
            at += f", {states.parameter.over} = {value:.6g}"
            states = states.states_at(value)

        why = verdict.why
        if attempt is None:
            # A first step, or the one that an accepted step asks for, may be shorter than is allowed.
            why = f"the next step, {verdict.step:.3g}, is below nfrc.smallest_step"
        remedy = "increase nfrc.harmonics or nfrc.max_newton, or decrease nfrc.smallest_step"
        laws = [stops.law for stops in states.forces.contacts]
        if any(law.damping and not law.approach_floor for law in laws):
            # The damping factor is divided by the approach velocity, which vanishes where a contact begins.
            remedy += "; a contact with loss that only grazes its stop needs contacts.approach_floor in m/s"
        return f"no step from the last good point, {at}: {why}; {remedy}"


def first_state(
    states: SteadyStates | StatesOverKey, stop: StopRequest | None = None, is_ramp: bool = False
) -> Response:
    """Return the state at the lower end of the range, with its tangent towards larger parameters.

    Where the linear motion touches no contact it is that motion. Otherwise it is reached by growing amplitudes from one
    at which no contact is touched. If that fails, or if stops touch at rest, it is reached by growing weights of the
    contacts' forces. ``is_ramp`` says that ``states`` are those over growing amplitudes, whose first amplitude is so
    small that the linear motion is near. Raises ContinuationError if no way leads to the state, and StoppedError where
    a ``stop`` is requested on the way.
    """
    stop = stop or StopRequest()
    if isinstance(states, StatesOverKey):
        low, _ = states.options.range
        # With the key at its first value this is a state over the amplitude.
        guess = states.from_state(low, first_state(states.states_at(low), stop).xi)
        return _begun(states, guess)

    low = states.options.range[0] / states.parameter.scale
    omega, amplitude = states.drive(low)
    linear = states.linear_motion(omega).harmonics
    guess = states.balance.pack(amplitude * linear) / states.clearance
    # A stop that touches at rest acts at every amplitude: no small one is linear.
    if any(0 in (stops.plus, stops.minus) for stops in states.forces.contacts):
        guess = _by_weights(states, omega, amplitude, stop)
    elif _touches(states, amplitude * linear[:, states.periods]) and not is_ramp:
        guess = _by_amplitudes(states, omega, amplitude, stop)

    return _begun(states, np.append(guess, low))


def _begun(states: SteadyStates | StatesOverKey, guess: np.ndarray) -> Response:
    """Return the state near the unknowns ``guess`` with their parameter, from which the parameter grows."""
    # The guess is the linear motion, or the end of a homotopy, which is a state already but for rounding.
    start = Response(xi=states.at(guess, guess[-1]), next_step=states.options.first_step)
    tangent = states.first_tangent(start, 1)
    return Response(xi=start.xi, tangent=tangent, next_step=start.next_step)


def _touches(states: SteadyStates, linear: np.ndarray) -> bool:
    """Return whether a state differs from the linear motion ``linear`` (pairs,), the first harmonics in m.

    It does where that motion comes to a stop, or opens a contact that is pressed at rest. Springs that are not linear
    act at every amplitude: with them the answer is always yes.
    """
    if states.forces.springs:
        return True
    for stops, motion in zip(states.forces.contacts, np.abs(linear).tolist(), strict=True):
        if not motion < abs(stops.clearance):
            return True
    return False


def _by_weights(states: SteadyStates, omega: float, amplitude: float, stop: StopRequest) -> np.ndarray:
    """Return the scaled harmonics of the state at ``omega`` to which growing weights of the contacts' forces lead.

    The forces of all contacts, less those of springs in their place, are multiplied by a weight s^4. Each contact has a
    parallel dashpot of (1 - s) d, where d = 1/(Om |G_jj(Om)|) in N s/m is the impedance of the lattice at its pair j.
    The state is followed from s = 0, where the system is linear, to s = 1. The curve cannot come back to s = 0, where
    there is no other state, and the dashpots keep it from resonances. The power gives stiff contacts, which act at
    small weights already, a long part of the path.

    ``omega`` is in rad/s. Raises ContinuationError where the curve does not reach s = 1, StoppedError as ``_followed``.
    """
    impedance = 1 / (omega * np.abs(np.diag(states.compliance.at(np.array([omega]))[0])))
    update = {"over": "amplitude", "range": [amplitude, 2 * amplitude], "fixed": [omega]}
    case = states.case.model_copy(update={"nfrc": states.options.model_copy(update=update)})

    def weighted(s: float) -> SteadyStates:
        """Return the equations with contacts, and the nonlinear parts of springs, of the weight s^4."""
        stops = [
            one._replace(weight=s**4, drag=(1 - s) * drag, spring=s**4 * one.spring)
            for one, drag in zip(states.forces.contacts, impedance.tolist(), strict=False)
        ]
        springs = [
            replace(one, quadratic=s**4 * one.quadratic, cubic=s**4 * one.cubic) for one in states.forces.springs
        ]
        return SteadyStates(case, states.restitution, omega, forces=SiteForces(stops, springs), like=states)

    options = case.nfrc.model_copy(update={"range": [0.0, 1.0]})
    weights = StatesOverKey(weighted, "weight of contacts", amplitude, options)
    # At s = 0 the dashpots change the linear motion, but the equations are linear: one Newton step corrects it.
    linear = amplitude * states.linear_motion(omega).harmonics
    start = _begun(weights, np.append(states.balance.pack(linear) / weights.clearance, 0.0))
    points = _followed(Continuation(weights, start, TurningSteps(weights, MOST_WEIGHTS)), stop)
    if not points or points[-1].xi[-1] * weights.parameter.scale != 1.0:
        remedy = "begin nfrc.range or nfrc.fixed at another value"
        raise ContinuationError(f"no state with closed contacts is found at amplitude {amplitude:g}; {remedy}")
    return points[-1].xi[:-1] * (weights.clearance / states.clearance)


def _by_amplitudes(states: SteadyStates, omega: float, amplitude: float, stop: StopRequest) -> np.ndarray:
    """Return scaled harmonics of the state at ``omega`` in rad/s, by amplitudes that grow from 1e-3 of ``amplitude``.

    With stiff contacts that have a loss, states over the amplitude may come to motions that close a contact ever more
    slowly, as the damping factor is divided by the speed at which it closes: steps become ever shorter. They may also
    end where one contact episode becomes two, of which the second begins without speed. Growing weights may then lead
    to the beginning of the range.
    """
    update = {"over": "amplitude", "range": [1e-3 * amplitude, amplitude], "fixed": [omega]}
    below = states.options.model_copy(update=update)
    case = states.case.model_copy(update={"nfrc": below})
    ramp = SteadyStates(case, states.restitution, omega, like=states)
    most = max(MOST_RAMP, int(LONGEST_RAMP / states.options.largest_step))
    try:
        start = first_state(ramp, stop, is_ramp=True)
        points = _followed(Continuation(ramp, start, TurningSteps(ramp, most)), stop)
    except ContinuationError:
        points = []
    if not points or not np.isclose(points[-1].xi[-1] * ramp.parameter.scale, amplitude):
        return _by_weights(states, omega, amplitude, stop)
    return points[-1].xi[:-1] * (ramp.clearance / states.clearance)


def _followed(curve: Continuation[Response], stop: StopRequest) -> list[Response]:
    """Return all points of a ``curve``; raises StoppedError at the next one where a ``stop`` is requested."""
    points = []
    for point in curve:
        if stop.requested:
            raise StoppedError("stopped on request before the first point; continue with --resume")
        points.append(point)
    return points
