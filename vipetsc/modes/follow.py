"""Follow the branches of a case: one by one or shared over ranks, saved as they grow, resumed where they ended."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import NnmCase
from vipetsc.case.nnm import NnmTable
from vipetsc.io.folder import BRANCHES, claim_folder, provenance
from vipetsc.modes.audit import BranchMonitor, is_jump, suspects
from vipetsc.modes.branch import Branch
from vipetsc.modes.continuation import Continuation, ContinuationError, Guards, StepControl
from vipetsc.modes.newmark import Newmark
from vipetsc.modes.orbit import Dop853Flow, FiniteDifferences, Flow, FlowError
from vipetsc.modes.point import Point, linear_start
from vipetsc.modes.samples import compare, resonance, sample_orbit
from vipetsc.modes.shooting import MAPS, Corrector, Shooting
from vipetsc.modes.special import Locator, switch
from vipetsc.modes.system import System
from vipetsc.modes.tsrk import Tsrk

# The flows by their names in case files.
FLOWS: dict[str, type[Flow]] = {flow.name: flow for flow in (Dop853Flow, Tsrk, Newmark)}
# Points between two writings of a growing branch.
SAVE_EVERY = 500
FAILURES = (ContinuationError, FlowError, ValueError)

Listener = Callable[[Branch, Point], None]


def prepare_folder(case: NnmCase, folder: Path, force: bool, resume: bool) -> None:
    """Make ``folder`` ready for the branches of ``case`` (rank 0 only); raises FolderError if it is not ours."""

    def difference(earlier: str) -> str | None:
        same = NnmCase.from_toml(earlier).physics() == case.physics()
        return None if same else "--resume needs the system, map and flow that its branches were begun with"

    claim_folder(folder, BRANCHES, case.to_toml(), force=force, resume=resume, difference=difference)


def follow_all(
    case: NnmCase, folder: Path, comm: MPI.Comm, resume: bool = False, listener: Listener | None = None
) -> list[Branch]:
    """All branches of ``case``, written into ``folder``; rank r follows every size-th one, from r on.

    Each branch is computed on one rank, so that its bits do not depend on their number. A branch that fails is
    written as far as it came, says why in its ``ending``, and the others go on. Returns all branches on rank 0, in the
    order of ``nnm.modes``; an empty list on the others.
    """
    mine = {}
    for job in range(comm.rank, len(case.nnm.modes), comm.size):
        follower = Follower(case, folder, provenance(comm), listener)
        mine[job] = follower.follow(case.nnm.modes[job] - 1, resume)
    gathered = comm.gather(mine) or []
    branches = {job: group for part in gathered for job, group in part.items()}
    return [branch for job in sorted(branches) for branch in branches[job]]


def create_corrector(options: NnmTable, system: System) -> Corrector:
    """Flow, map and solver as the options have them."""
    flow: Flow = FLOWS[options.flow](system)
    if options.jacobian == "differences":
        flow = FiniteDifferences(flow)
    automatic = "quarter" if system.odd else "half"
    shooting_map = MAPS[automatic if options.map == "auto" else options.map]
    return Corrector(Shooting(flow, shooting_map), options.tolerance, max_newton=options.max_newton)


def create_control(options: NnmTable) -> StepControl:
    """Step control as the options have it; a guard of 0 is off."""
    return StepControl(
        first=options.first_step,
        smallest=options.smallest_step,
        largest=options.largest_step,
        points=options.points,
        energy=(options.energy[0], options.energy[1]),
        frequency=(options.frequency[0], options.frequency[1]),
        chart=options.chart,
        guards=Guards(**{k: v if v > 0 else math.inf for k, v in options.guards.model_dump().items()}),
    )


@dataclass
class Follower:
    """Follows the branches of a case into a folder; ``about`` are attributes of the files."""

    case: NnmCase
    folder: Path
    about: dict[str, Any]
    listener: Listener | None = None

    def __post_init__(self) -> None:
        self.options, self.system = self.case.nnm, System.from_case(self.case)
        self.corrector, self.control = create_corrector(self.options, self.system), create_control(self.options)

    def follow(self, mode: int, resume: bool = False) -> list[Branch]:
        """The branch of ``mode`` (0-based), then the branches that cross it if the case asks for them."""
        name, options = self.system.branch_name(mode), self.options
        branch, path = self._empty(name), self.folder / f"branch-{name}.h5"
        if resume and path.exists():
            branch = Branch.read(path)
            branch.case = self.case.to_toml()
            if branch.complete:
                return [branch]
        try:
            start = branch.regular()[-1] if branch.points else self._start(mode)
            if options.direction == "both" and not branch.points:
                down = self._empty(name)
                self.grow(down, self.corrector, start, self.control, -1)
                # from the far end towards the start, with the tangents turned round
                branch.points = [_turned(p) for p in reversed(down.points)]
                branch.findings += down.findings
            direction = -1 if options.direction == "down" else 1
            self.grow(branch, self.corrector, start, self.control, direction, save=True)
            self._store_orbits(branch)
            flows = [FLOWS[flow](self.system) for flow in options.compare]
            branch.comparisons = [compare(self.corrector, branch.regular(), flow) for flow in flows]
        except FAILURES as error:
            branch.ending = f"failed: {error}"
        branch.write(self.folder, self.about)
        return [branch, *self._crossing(branch)]

    def grow(
        self,
        branch: Branch,
        corrector: Corrector,
        start: Point,
        control: StepControl,
        direction: int = 1,
        save: bool = False,
    ) -> None:
        """Continue ``branch`` from ``start`` until it ends; its special points are located on the way.

        Raises ContinuationError or FlowError if it cannot go on; the branch holds the points so far.
        """
        control = replace(control, points=max(control.points - max(len(branch.regular()) - 1, 0), 0))
        points = Continuation(corrector, start, control, direction, branch.next_step or None)
        locator = Locator(corrector, control.chart, self.options.locate_grazing)
        monitor = BranchMonitor(corrector)
        for point in branch.regular():
            monitor.check(point)
        last, finding = points.point, None
        branch.points = branch.points or [last]
        try:
            for point in points:
                if self.options.locate:
                    branch.points += [_labelled(p, corrector.problem) for p in locator.between(last, point)]
                branch.points.append(point)
                branch.next_step = points.step
                if self.listener is not None:
                    self.listener(branch, point)
                finding = monitor.check(point)
                if finding is not None:
                    branch.findings.append(finding)
                    break
                if save and point.index % SAVE_EVERY == 0:
                    branch.write(self.folder, self.about)
                last = point
        finally:
            branch.findings += [jump for jump in _jumps(branch, corrector, control) if jump not in branch.findings]
        branch.ending, branch.complete = finding or points.ending, finding is not None or points.finished

    def _empty(self, name: str) -> Branch:
        return Branch(name, self.case.to_toml(), self.system.dofs)

    def _start(self, mode: int) -> Point:
        if self.options.start_energy != "auto":
            return linear_start(self.corrector, mode, self.options.start_energy)
        graze = self.system.grazing_energy(mode)
        energy = graze / 100 if math.isfinite(graze) else 1e-3
        return linear_start(self.corrector, mode, max(energy, self.options.energy[0] * 1.001))

    def _store_orbits(self, branch: Branch) -> None:
        """Orbits in the middle of every region, and at the energies asked for."""
        regular, regions = branch.regular(), branch.regions()
        pairs = [(region, p) for region, p in zip(regions, branch.points, strict=True) if p.kind == "regular"]
        groups = [[p for region, p in pairs if region == number] for number in range(5)]
        chosen = [group[len(group) // 2] for group in groups if group]
        for energy in self.options.orbits_at:
            chosen.append(min(regular, key=lambda p: abs(math.log(p.energy / energy))))
        branch.orbits = [(p, sample_orbit(self.corrector.problem, p)) for p in chosen]

    def _crossing(self, branch: Branch) -> list[Branch]:
        """The branches that cross ``branch`` at the kinds of special points asked for."""
        control = replace(self.control, points=self.options.switch_points, chart="relative")
        branches = []
        for kind in self.options.switch:
            for number, point in enumerate(branch.special(kind), 1):
                crossing = self._empty(f"{branch.name}-{kind}-{number}")
                try:
                    corrector, first = switch(self.corrector, point, self.options.switch_amplitude)
                    self.grow(crossing, corrector, first, control)
                except FAILURES as error:
                    crossing.ending = f"failed: {error}"
                crossing.write(self.folder, self.about)
                branches.append(crossing)
        return branches


def _jumps(branch: Branch, corrector: Corrector, control: StepControl) -> Iterator[str]:
    """Sentences about steps that jumped to another arc; only suspicious ones are followed again."""
    regular = branch.regular()
    for i, why in suspects(regular):
        a, b = regular[i], regular[i + 1]
        try:
            jumped = is_jump(corrector, a, b, control)
        except (ContinuationError, FlowError):
            jumped = True
        if jumped:
            yield (
                f"jump between points {a.index} and {b.index} (E = {a.energy:.6g} -> {b.energy:.6g} J, "
                f"f = {a.frequency:.6g} -> {b.frequency:.6g} Hz): {why}; both satisfy the equations "
                f"(residuals {a.residual:.0e}, {b.residual:.0e})"
            )


def _turned(point: Point) -> Point:
    """The same point on the branch followed the other way."""
    return replace(point, tangent=-point.direction, energy_tangent=-point.energy_tangent)


def _labelled(point: Point, problem: Shooting) -> Point:
    """Energy folds, where tongues begin and end, carry their resonance."""
    return replace(point, resonance=resonance(problem, point)) if point.kind == "fold-energy" else point
