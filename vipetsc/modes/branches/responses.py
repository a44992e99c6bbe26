"""Curves of steady states under a drive: the verb ``nfrc``."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from vipetsc.case.keys import unit_of
from vipetsc.case.nfrc import FRACTIONS, WALLS, NfrcCase, ResponseCurve, value_of
from vipetsc.endings import Ending
from vipetsc.io.branch_kinds import RESPONSES
from vipetsc.io.netcdf import Variables, variable
from vipetsc.lattice import ModalCompliance, WaveCompliance, nonlinear_springs
from vipetsc.modes.branches.branch import RESPONSE_KINDS, Branch
from vipetsc.modes.branches.method import CrossingBranch, Method, value_kind
from vipetsc.modes.cache import BoundedCache
from vipetsc.modes.problem import PeriodicProblem, SpecialKind
from vipetsc.modes.response.branch_switching import crossing_case, first_crossing
from vipetsc.modes.response.condensation import compliance_of
from vipetsc.modes.response.equations import FAILURES
from vipetsc.modes.response.isolated import is_on, over_amplitudes, places_of, subharmonic_states, unknown_states
from vipetsc.modes.response.linear import BESIDE, linear_states, linear_variables, resonances
from vipetsc.modes.response.over_key import KeyedCase, StatesOverKey
from vipetsc.modes.response.stability_changes import BRANCH_POINT
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import TurningSteps, first_state
from vipetsc.modes.special_curves import SpecialCurve, SpecialSteps, crosses_amplitude
from vipetsc.modes.stability import Stability
from vipetsc.parallel import StopRequest
from vipetsc.spectra.measures import JOINT
from vipetsc.wording import shortened

# Between the name of a curve and the number of an isolated one near it.
ISOLA = "-isola-"
# The same for curves of special points, after their kind.
CURVE = "-curve-"


class ResponseMethod(Method[Response]):
    """Curves of ``SteadyStates``: one for each restitution and each value of the parameter that is fixed."""

    kind = RESPONSES
    failures = FAILURES
    keeps_empty = False  # pictures and tables of curves need a first state
    finishes_files_alone = True  # the linear motions take longer than a short curve
    counts_start = True

    case: NfrcCase

    def __init__(self, case: NfrcCase) -> None:
        super().__init__(case)
        self.curves = case.every_curve()
        # The latest compliance by the number of its member: the curves of a member follow each other.
        self._compliance: tuple[int, WaveCompliance | ModalCompliance] | None = None

    @staticmethod
    def jobs(case: Any) -> list[int]:
        """Return numbers of a case's curves."""
        return list(range(len(case.every_curve())))

    def new_branch(self, name: str) -> Branch[Response]:
        """Return a curve without states, an isolated one near it, or one that crosses it."""
        base, special_kind = _without_curve(name)
        case_of = None
        for kind in self.case.nfrc.switch:
            base, crosses, _ = base.partition(f"-{kind}-")
            if crosses:
                case_of = kind
        base, isola, number = base.partition(ISOLA)
        curve = next(curve for curve in self.curves if curve.name == base)
        case = curve.case
        if case_of is not None:
            case = crossing_case(case, case_of)

        about: dict[str, Any] = {"over": case.nfrc.over, "restitution": curve.restitution}
        if case.nfrc.varies_key:
            about["unit"] = unit_of(case.nfrc.over, case.model_dump(by_alias=True, exclude_none=True))
        if isola:
            about["isola"] = number
        if special_kind:
            about["special"] = special_kind
        if case.nfrc.subharmonic > 1:
            about["drive_harmonic"] = case.nfrc.subharmonic
        if curve.values:
            about["family"] = curve.values

        return Branch(
            name=name,
            case=case.to_toml(),
            dofs=len(case.model().chain.sites),
            kind=self.kind,
            about=about,
            extra=_axes(case),
        )

    def name(self, job: int) -> str:
        """Return the name of a curve."""
        return self.curves[job].name

    def problem(self, job: int) -> SteadyStates | StatesOverKey:
        """Return the equations of a curve."""
        return self._equations(self.curves[job], self.curves[job].case)

    def computed(self, job: int) -> list[Response] | None:
        """Return the linear motions of a lattice without contacts and nonlinear springs."""
        curve = self.curves[job]
        if not curve.case.is_linear:
            return None
        return list(linear_states(curve.case, curve.fixed, self._compliance_of(curve)))

    def findings(self, job: int, points: list[Response]) -> list[str]:
        """Return a sentence on the linear motions at frequencies of modes that nothing damps."""
        curve = self.curves[job]
        shifted = list(linear_states(curve.case, curve.fixed, self._compliance_of(curve), BESIDE))
        at = resonances(points, shifted)
        if not at:
            return []
        listed = shortened([f"{omega:.9g}" for omega in dict.fromkeys(at)])
        return [
            f"at {listed} rad/s, the frequency of a mode without damping, the response has no bound: its values there"
            " are rounding; change nfrc.range or nfrc.points, or give the lattice dashpots"
        ]

    def finish(self, problem: PeriodicProblem[Response], branch: Branch[Response]) -> None:
        """Add the linear motions under a force or a wall, with which a curve is compared."""
        if not isinstance(problem, SteadyStates) or problem.wave:
            return
        options = problem.options
        fixed = problem.parameter.fixed
        states = list(linear_states(problem.case, fixed, problem.compliance))
        branch.extra |= linear_variables(states, options.over)

    def _equations(self, curve: ResponseCurve, case: NfrcCase) -> SteadyStates | StatesOverKey:
        """Return the equations of a ``curve``, with the harmonics of a ``case``."""
        options = case.nfrc
        if options.varies_key:
            keyed = KeyedCase(case, curve.restitution, curve.fixed)
            return StatesOverKey(keyed.at, options.over, curve.fixed, options)
        return SteadyStates(case, curve.restitution, curve.fixed, compliance=self._compliance_of(curve))

    def _compliance_of(self, curve: ResponseCurve) -> WaveCompliance | ModalCompliance:
        """Return the compliance of the lattice of a ``curve``."""
        if self._compliance is None or self._compliance[0] != curve.member:
            self._compliance = curve.member, compliance_of(curve.case)
        return self._compliance[1]

    def start(self, problem: PeriodicProblem[Response], job: int, stop: StopRequest | None = None) -> Response:
        """Return the state at the beginning of the range."""
        assert isinstance(problem, SteadyStates | StatesOverKey)
        return first_state(problem, stop)

    def rule(self, problem: PeriodicProblem[Response], start: Response, done: int) -> TurningSteps:
        """Return steps to the end of the range; the start counts among ``nfrc.points``."""
        assert isinstance(problem, SteadyStates | StatesOverKey)
        return TurningSteps(problem, max(self.case.nfrc.points - 1 - done, 0))

    def further(self, branch: Branch[Response], followed: Sequence[Branch[Response]]) -> Iterator[CrossingBranch]:
        """Yield the isolated curves near a curve, and those that cross it or one of these at ``nfrc.switch``."""
        yield from self._isolas(branch, followed)
        curve = next(curve for curve in self.curves if curve.name == branch.name)
        for kind in self.case.nfrc.curves_of:
            for number, point in enumerate((p for p in branch.points if p.kind == kind), 1):
                yield from self._special_curve(curve, point, f"{branch.name}-{kind}{CURVE}{number}", followed)
        for other in [branch, *followed]:
            if "special" in other.about:
                continue
            for kind in self.case.nfrc.switch:
                for number, point in enumerate((p for p in other.points if p.kind == kind), 1):
                    yield from self._crossing(curve, point, f"{other.name}-{kind}-{number}", followed)

    def _special_curve(
        self, curve: ResponseCurve, point: Response, name: str, followed: Sequence[Branch[Response]]
    ) -> Iterator[CrossingBranch]:
        """Yield curve of special points through a special ``point``, in both directions, unless followed already."""
        states = self._equations(curve, curve.case)
        assert isinstance(states, SteadyStates)

        def rule(problem: PeriodicProblem[Response], start: Response, done: int) -> SpecialSteps:
            assert isinstance(problem, SpecialCurve)
            return SpecialSteps(problem, start, max(self.case.nfrc.points - 1 - done, 0))

        def start(side: int) -> tuple[SpecialCurve, Response]:
            problem = SpecialCurve(states, point.kind, point)
            return problem, problem.start(side)

        others = [other.points for other in followed if other.about.get("special") == point.kind]
        if any(crosses_amplitude(points, point) for points in others):
            return
        yield CrossingBranch(name, partial(start, 1), rule)
        if followed[-1].ended.ending is not Ending.CLOSED:
            yield CrossingBranch(f"{name}-back", partial(start, -1), rule)

    def _crossing(
        self, curve: ResponseCurve, point: Response, name: str, followed: Sequence[Branch[Response]]
    ) -> Iterator[CrossingBranch]:
        """Yield the curve that crosses at a special ``point``, in both directions unless they are the same motions.

        Those are shifted by a period of the drive at a period doubling, mirror images where a symmetry is lost. A curve
        that crosses a second time is not followed again.
        """
        old = self._equations(curve, curve.case)
        case = crossing_case(curve.case, point.kind)

        def rule(problem: PeriodicProblem[Response], start: Response, done: int) -> TurningSteps:
            assert isinstance(problem, SteadyStates | StatesOverKey)
            return TurningSteps(problem, max(self.case.nfrc.points - 1 - done, 0), start)

        def start(side: int) -> tuple[SteadyStates | StatesOverKey, Response]:
            return first_crossing(old, point, self._equations(curve, case), side)

        names = {1: name}
        if point.kind == BRANCH_POINT and not curve.case.nfrc.symmetric:
            names[-1] = f"{name}-back"
        for side, of_side in names.items():
            # Where no state is found the curve's file says why.
            with suppress(*FAILURES):
                states, first = start(side)
                if is_on(states, [other.points for other in followed], first.xi):
                    continue
            yield CrossingBranch(of_side, partial(start, side), rule)

    def _isolas(self, branch: Branch[Response], followed: Sequence[Branch[Response]]) -> Iterator[CrossingBranch]:
        """Yield the isolated curves that are found near a curve, in both directions where they are not closed."""
        if not (self.case.nfrc.isolas and branch.complete):
            return
        states = self.problem(next(job for job in self.jobs(self.case) if self.name(job) == branch.name))

        def curves_so_far() -> list[list[Response]]:
            return [branch.points, *(other.points for other in followed)]

        places = places_of(states, self.case.nfrc.isolas)
        number = 0
        for p in places.tolist():
            if states.periods > 1:
                candidates = subharmonic_states(states, p)
            else:
                candidates = over_amplitudes(states, curves_so_far(), p)
            for xi in unknown_states(states, curves_so_far, candidates):
                number += 1
                start = Response(xi=xi, next_step=states.options.first_step)
                first = replace(start, tangent=states.first_tangent(start, 1))
                yield self._isola(states, first, f"{branch.name}{ISOLA}{number}")
                if not followed[-1].complete:
                    return  # states on what is left of it would be found again
                if followed[-1].ended.ending is not Ending.CLOSED:
                    back = replace(first, tangent=-first.tangent)
                    yield self._isola(states, back, f"{branch.name}{ISOLA}{number}-back")

    def _isola(self, states: SteadyStates | StatesOverKey, first: Response, name: str) -> CrossingBranch:
        """Return the isolated curve of that ``name`` through the ``first`` state, along its tangent."""

        def rule(problem: PeriodicProblem[Response], start: Response, done: int) -> TurningSteps:
            return TurningSteps(states, max(self.case.nfrc.points - 1 - done, 0), first)

        return CrossingBranch(name, lambda: (states, first), rule)

    def chosen(self, problem: PeriodicProblem[Response]) -> list[SpecialKind[Response]]:
        """Return the states at the values ``nfrc.points_at``, within the range."""
        if isinstance(problem, SpecialCurve):
            return []
        assert isinstance(problem, SteadyStates | StatesOverKey)
        options = self.case.nfrc
        of_curve = self.case.measures()
        low, high = (bound / problem.parameter.scale for bound in options.range)
        rounding = 1e-9 * (high - low)
        # All values of all quantities are compared at the same few states.
        latest = BoundedCache[bytes, dict[str, Any]](4)

        def measured(xi: np.ndarray) -> dict[str, Any]:
            # The stability, which is not asked for here, is computed where the state is assessed.
            measures = problem.measured(xi, Stability(0))
            fields = measures._asdict() | dict(measures.outputs)
            return fields | {"share": measures.fractions}

        def quantity(name: str, point: Response) -> float:
            return value_of(of_curve, name, latest.get(point.xi.tobytes(), lambda: measured(point.xi)))

        def is_within(point: Response) -> bool:
            return bool(low - rounding <= point.xi[-1] <= high + rounding)

        return [
            value_kind(name, value, partial(quantity, name), is_within)
            for name, values in options.points_at.items()
            for value in values
        ]

    def assess(self, problem: PeriodicProblem[Response], point: Response) -> Response:
        """Return the state with its measures, which special points have already."""
        if point.measures is not None:
            return point
        assert isinstance(problem, SteadyStates | StatesOverKey | SpecialCurve)
        return replace(point, measures=problem.measured(point.xi))


def _without_curve(name: str) -> tuple[str, str]:
    """Return the name of the curve on which a curve of special points begins, and their kind; "" of any other curve."""
    base, curve, _ = name.partition(CURVE)
    if not curve:
        return name, ""
    kind = next(kind for kind in RESPONSE_KINDS if base.endswith(f"-{kind}"))
    return base.removesuffix(f"-{kind}"), kind


def _axes(case: NfrcCase) -> Variables:
    """Return the coordinates of variables of states: sites, harmonics, channels, points and pairs of [output]."""
    chain = case.model().chain
    last_harmonic = 1 if case.is_linear else case.nfrc.harmonics
    orders = np.arange(last_harmonic + 1)
    axes = {
        "site": variable("site", chain.sites.cells + 1, "1", "cell of the site, counted from 1"),
        "order": variable("order", orders, "1", "harmonic of the motion"),
        "way": variable("way", np.array(FRACTIONS), "1", "destination of the energy"),
        "clearance": variable("site", chain.sites.clearances, "m", "clearance"),
    }

    if not chain.is_linear:
        labels = nonlinear_springs(chain).labels()
        text = "cell in which a nonlinear spring begins (0: left wall), and its number there, both from 1"
        axes["spring"] = variable("spring", np.array(labels), "1", text)
    output = case.output
    if output.points:
        names = np.array([point.name for point in output.points])
        axes["location"] = variable("location", names, "1", "named mass, see output.points in the case")
    if output.transmission:
        pairs = np.array([JOINT.join(pair) for pair in output.transmission])
        axes["pair"] = variable("pair", pairs, "1", "locations of a transmission, from - to")
    if output.forces and case.lattice.ends == "fixed" and not (case.nfrc.infinite or case.nfrc.open_ends):
        axes["wall"] = variable("wall", np.array(WALLS), "1", "wall at an end of the lattice")
    return axes
