"""Follow the branches of a case: one by one or shared over ranks, saved as they grow, resumed where they ended."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np

from vipetsc.case.nnm import NnmCase, NnmTable
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import provenance
from vipetsc.io.store import FolderError, claim_folder
from vipetsc.modes.audit import Watch, is_jump, suspects
from vipetsc.modes.branch import Branch
from vipetsc.modes.compare import compare
from vipetsc.modes.continuation import Continuation, ContinuationError, Guards, StepControl
from vipetsc.modes.newmark import Newmark
from vipetsc.modes.orbit import Dop853Flow, FiniteDifferences, Flow, FlowError
from vipetsc.modes.point import Point, linear_start
from vipetsc.modes.portrait import portrait, resonance
from vipetsc.modes.shooting import MAPS, Corrector, Shooting
from vipetsc.modes.special import Locator
from vipetsc.modes.switching import switch
from vipetsc.modes.system import System
from vipetsc.modes.tsrk import Tsrk

FLOWS: dict[str, type[Flow]] = {flow.name: flow for flow in (Dop853Flow, Tsrk, Newmark)}
"""The flows by their names in case files."""

SAVE_EVERY = 500
"""Points between two writings of a growing branch."""

Listener = Callable[[Branch, Point], None]


def prepare_folder(case: NnmCase, folder: Path, force: bool, resume: bool) -> None:
    """Make ``folder`` ready for the branches of ``case`` (rank 0 only); raises FolderError if it is not ours."""
    kept = folder / "case.toml"
    if resume:
        if not kept.exists():
            raise FolderError(f"{folder}: holds no branches to resume; leave out --resume")
        if NnmCase.load(kept).physics() != case.physics():
            raise FolderError(f"{folder}: --resume needs the system, map and flow that {kept} was begun with")
    else:
        claim_folder(folder, force, ("run.h5", "parts", "design.h5"), "--resume goes on with the branches in it, ")
        for old in folder.glob("branch-*.*"):
            old.unlink()
    write_text(kept, case.to_toml())


def follow_all(
    case: NnmCase,
    folder: Path,
    comm: MPI.Comm,
    resume: bool = False,
    listener: Listener | None = None,
) -> list[Branch]:
    """All branches of ``case``, written into ``folder``; rank r follows every size-th one, from r on.

    Each branch is computed on one rank, so that its bits do not depend on their number. A branch that fails is
    written as far as it came, says why in its ``ending``, and the others go on.

    Returns
    -------
    list of Branch
        All branches on rank 0, in the order of ``nnm.modes``; an empty list on the others.
    """
    own = []
    for job, mode in enumerate(case.nnm.modes):
        if job % comm.size == comm.rank:
            own.append((job, follow(case, mode, folder, provenance(comm), resume, listener)))
    gathered = comm.gather(own)
    found = sorted((pair for part in gathered or [] for pair in part), key=lambda pair: pair[0])
    return [branch for _, branches in found for branch in branches]


def follow(
    case: NnmCase,
    mode: int,
    folder: Path,
    about: dict,
    resume: bool = False,
    listener: Listener | None = None,
) -> list[Branch]:
    """The branch of one mode (1-based), then the branches that cross it if the case asks for them."""
    options, system = case.nnm, System.from_case(case)
    name = system.branch_name(mode - 1)
    corrector = corrector_of(options, system)
    branch = Branch(name, case.to_toml(), system.dofs)
    path = folder / f"branch-{name}.h5"
    if resume and path.exists():
        branch = Branch.read(path)
        branch.case = case.to_toml()
        if branch.complete:
            return [branch]
    try:
        start = branch.regular()[-1] if branch.points else _start(options, corrector, system, mode)
        if options.direction == "both" and not branch.points:
            down = Branch(name, branch.case, system.dofs)
            grow(down, corrector, options, start, -1, listener, save=None)
            # from the far end towards the start, with the tangents turned round
            branch.points = [_turned(p) for p in reversed(down.points)]
            branch.findings += down.findings
        direction = -1 if options.direction == "down" else 1
        grow(branch, corrector, options, start, direction, listener, save=lambda: branch.write(folder, about))
        _store_orbits(branch, corrector.problem, options)
        branch.comparisons = [compare(corrector, branch.regular(), FLOWS[f](system)) for f in options.compare]
    except (ContinuationError, FlowError, ValueError) as error:
        branch.ending = f"failed: {error}"
    branch.write(folder, about)
    crossing = _crossing(branch, corrector, options, listener, folder, about) if options.switch else []
    return [branch, *crossing]


def corrector_of(options: NnmTable, system: System) -> Corrector:
    """Flow, map and solver as the options have them."""
    flow = FLOWS[options.flow](system)
    if options.jacobian == "differences":
        flow = FiniteDifferences(flow)
    name = options.map
    if name == "auto":
        name = "quarter" if system.odd else "half"
    return Corrector(Shooting(flow, MAPS[name]), options.tolerance, max_newton=options.max_newton)


def control_of(options: NnmTable) -> StepControl:
    """Step control as the options have it; a guard of 0 is off."""
    guards = {k: v if v > 0 else math.inf for k, v in options.guards.model_dump().items()}
    return StepControl(
        first=options.first_step,
        smallest=options.smallest_step,
        largest=options.largest_step,
        points=options.points,
        energy=tuple(options.energy),
        frequency=tuple(options.frequency),
        chart=options.chart,
        guards=Guards(**guards),
    )


def grow(
    branch: Branch,
    corrector: Corrector,
    options: NnmTable,
    start: Point,
    direction: int,
    listener: Listener | None,
    save: Callable[[], None] | None,
) -> None:
    """Continue ``branch`` from ``start`` until it ends; its special points are located on the way.

    Raises
    ------
    ContinuationError, FlowError
        If it cannot go on; the branch holds the points found so far.
    """
    control = control_of(options)
    done = max(len(branch.regular()) - 1, 0)
    control = replace(control, points=max(control.points - done, 0))
    points = Continuation(corrector, start, control, direction, branch.next_step or None)
    locator = Locator(corrector, options.chart, options.locate_grazing)
    watch = Watch(corrector)
    for point in branch.regular():
        watch.see(point)
    last = points.point
    stopped = None
    if not branch.points:
        branch.points.append(last)
    try:
        for point in points:
            if options.locate:
                branch.points += [_labelled(p, corrector.problem) for p in locator.between(last, point)]
            branch.points.append(point)
            branch.next_step = points.step
            if listener is not None:
                listener(branch, point)
            stopped = watch.see(point)
            if stopped is not None:
                branch.findings.append(stopped)
                break
            if save is not None and point.index % SAVE_EVERY == 0:
                save()
            last = point
    finally:
        jumps = _jumps(branch, corrector, control)
        branch.findings += [jump for jump in jumps if jump not in branch.findings]
    branch.ending, branch.complete = stopped or points.ending, stopped is not None or points.finished


def _jumps(branch: Branch, corrector: Corrector, control: StepControl) -> Iterator[str]:
    """Sentences about steps that jumped to another arc; only suspicious ones are followed again."""
    regular = branch.regular()
    for i, why in suspects(regular):
        try:
            jumped = is_jump(corrector, regular[i], regular[i + 1], control)
        except (ContinuationError, FlowError):
            jumped = True
        if jumped:
            a, b = regular[i], regular[i + 1]
            yield (
                f"jump between points {a.index} and {b.index} (E = {a.energy:.6g} -> {b.energy:.6g} J, "
                f"f = {a.frequency:.6g} -> {b.frequency:.6g} Hz): {why}; both satisfy the equations "
                f"(residuals {a.residual:.0e}, {b.residual:.0e})"
            )


def _start(options: NnmTable, corrector: Corrector, system: System, mode: int) -> Point:
    energy = options.start_energy
    if energy == "auto":
        graze = system.grazing_energy(mode - 1)
        energy = graze / 100 if math.isfinite(graze) else 1e-3
        energy = max(energy, options.energy[0] * 1.001)
    return linear_start(corrector, mode - 1, energy)


def _labelled(point: Point, problem: Shooting) -> Point:
    """Energy folds, where tongues begin and end, carry their resonance."""
    if point.kind != "fold-energy":
        return point
    return replace(point, resonance=resonance(problem, point))


def _turned(point: Point) -> Point:
    return replace(point, tangent=-point.tangent, rise=-point.rise)


def _store_orbits(branch: Branch, problem: Shooting, options: NnmTable) -> None:
    """Orbits at the energies asked for, and one in the middle of every region."""
    regular = [(i, p) for i, p in enumerate(branch.points) if p.kind == "regular"]
    region = branch.column("region")
    chosen = []
    for number in range(5):
        inside = [p for i, p in regular if region[i] == number]
        if inside:
            chosen.append(inside[len(inside) // 2])
    for energy in options.orbits_at:
        nearest = min((p for _, p in regular), key=lambda p: abs(np.log(p.energy / energy)))
        chosen.append(nearest)
    branch.orbits = [(p, portrait(problem, p)) for p in chosen]


def _crossing(
    branch: Branch, corrector: Corrector, options: NnmTable, listener: Listener | None, folder: Path, about: dict
) -> list[Branch]:
    """The branches that cross ``branch`` at the kinds of special points asked for."""
    found = []
    for kind in options.switch:
        for number, point in enumerate(branch.special(kind), 1):
            name = f"{branch.name}-{kind}-{number}"
            crossing = Branch(name, branch.case, branch.dofs)
            try:
                fresh, first = switch(corrector, point, options.switch_amplitude)
                short = options.model_copy(update={"points": options.switch_points, "chart": "relative"})
                grow(crossing, fresh, short, first, 1, listener, save=None)
            except (ContinuationError, FlowError, ValueError) as error:
                crossing.ending = f"failed: {error}"
            crossing.write(folder, about)
            found.append(crossing)
    return found
