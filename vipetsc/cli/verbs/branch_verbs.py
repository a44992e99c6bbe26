"""The verbs ``nnm`` and ``nfrc``: branches of free and of driven periodic motions, which share their pictures."""

import itertools
import logging
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vipetsc.case import NnmCase
from vipetsc.case.amplitude import drive_unit
from vipetsc.case.keys import unit_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.cli.arguments import CASE, STUDY_ARGUMENTS, case_with
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.messages import echo_warnings, first_few, table
from vipetsc.cli.verb import Outcome, Rows, StudyVerb, Work
from vipetsc.endings import Ending
from vipetsc.io.kinds import BRANCHES
from vipetsc.parallel import on_root
from vipetsc.wording import counted, with_unit

if TYPE_CHECKING:
    from vipetsc.modes.branches.branch import Branch
    from vipetsc.modes.point import Point

logger = logging.getLogger(__name__)

MOST_SPECIAL = 4  # special points of a kind that are printed; the file has all
# Headings of the special points of frequency responses, by their kinds.
SPECIAL_POINTS = {
    "fold": "folds",
    "neimark-sacker": "Neimark-Sacker",
    "period-doubling": "period doubling",
    "branch-point": "branch points",
}
SHOW_EVERY = 0.5  # s between two lines of the live table, at which each can be read


def follow_modes(case: NnmCase, work: Work) -> Outcome:
    """Follow the branches of the case; the computed part of a failed branch is written."""

    def report(branch: "Branch") -> None:
        work.report(branch_table(branch))
        echo_warnings(work.comm, [f"{branch.name}: {finding}" for finding in [*branch.findings, *branch.missing]])

    return follow_branches(case, work, report, show_point=branch_log())


def follow_responses(case: NfrcCase, work: Work) -> Outcome:
    """Follow the curves of steady states of the case; the computed part of a failed curve is written."""
    return follow_branches(case, work, report=lambda curve: work.report(table(curve_rows(case, curve))))


def follow_branches(
    case: NnmCase | NfrcCase,
    work: Work,
    report: Callable[["Branch"], None],
    show_point: "Callable[[Branch, Point], None] | None" = None,
) -> Outcome:
    """Follow all branches of the case on all ranks, call ``report`` with each at the end, and publish their files.

    ``show_point`` is called with each new point while branches grow. The branches are on rank 0 alone. Collective.
    """
    from vipetsc.modes.branches.follow import claim_branches, follow_all

    comm = work.comm
    with claim_branches(case, work.folder, comm, work.options.force, work.options.resume) as claim:
        branches = follow_all(case, claim.folder, comm, claim.going_on, show_point, work.stop)
        for branch in branches:
            report(branch)

        # Raises after a request to stop: unfinished branches do not replace earlier ones.
        work.stop.check(comm)
        # If all branches failed before their first point, there is no file to replace earlier ones by.
        has_branches = on_root(comm, lambda: any(claim.folder.glob("branch-*.h5")))
        if has_branches:
            claim.publish()

    # Only rank 0 has the branches; all ranks must agree on how the verb ends.
    failures = [f"{b.name}: {b.ended.sentence}" for b in branches if b.ended.ending is Ending.FAILED]
    return Outcome(drawable=has_branches, failures=comm.bcast(failures))


def nnm_rows(case: NnmCase, ranks: int) -> Rows:
    """Return the rows of ``validate`` on nonlinear modes: system, modes, energies and contact law of the branches."""
    low, high = case.nnm.energy
    laws = dict.fromkeys(f"{law.law}, {law.stiffness:.6g} N/m^{law.onset_exponent:g}" for law in case.laws())
    return [
        ("nnm", f"{case.nnm.system} system, modes {first_few(case.nnm.modes)}, {low:g} to {high:g} J"),
        ("nnm contact", first_few(list(laws))),
    ]


def nfrc_rows(case: NfrcCase, ranks: int) -> Rows:
    """Return the rows of ``validate`` on steady states: lattice, number of curves, their parameter, fixed values."""
    options = case.nfrc
    if options.source == "wave":
        excitation = f"an incident wave of band {options.band}, {options.direction}"
        amplitude_unit = "of the clearance"
    else:
        excitation = f"a force on mass {case.drive.mass} of cell {case.drive.cell}"
        amplitude_unit = "N"
        if case.drive.end:
            excitation = f"the motion of the {case.drive.end} wall"
            amplitude_unit = "m"
        if case.drive.more:
            excitation += f", and {len(case.drive.more)} more in the ratios of the amplitudes"

    fixed = "amplitude"
    fixed_unit = amplitude_unit
    over_unit = "rad/s"
    if options.over == "amplitude":
        over_unit = amplitude_unit
        fixed = "frequency"
        fixed_unit = "rad/s"
    elif options.varies_key:
        over_unit = unit_of(options.over, case.table or {})
        fixed_unit += f", {case.drive.frequency:.6g} rad/s"

    low, high = options.range
    curves = counted(len(case.every_curve()), "curve")
    parity = "even and odd"
    if options.symmetric:
        parity = "odd only"

    lattice = dict(lattice_rows(case))
    if options.infinite:
        lattice["lattice"] = f"infinite, with sites in the cells of a segment of {case.lattice.cells}"
    restitutions = first_few([f"{restitution:g}" for restitution in options.restitutions]) or "of each site"
    return [
        *lattice.items(),
        ("nfrc", f"{curves} over the {options.over}, {low:g} to {high:g} {over_unit}".rstrip()),
        ("driven by", excitation),
        (f"at {fixed}", f"{first_few([f'{value:.6g}' for value in options.fixed])} {fixed_unit}"),
        ("restitution", restitutions),
        *_family_rows(case),
        *_isola_rows(case),
        ("harmonics", f"up to {options.harmonics}, {parity}; at most {options.points} points per curve"),
    ]


def _isola_rows(case: NfrcCase) -> Rows:
    """Return a row on where and how isolated curves are looked for; none if they are not."""
    options = case.nfrc
    if not options.isolas:
        return []
    places = counted(options.isolas, "place")
    return [("isolas", f"looked for at {places}, by amplitudes up to {options.isola_reach:g} times larger or smaller")]


def _family_rows(case: NfrcCase) -> Rows:
    """Return a row for each key that varies in the family of curves, with its values."""
    rows = []
    for key, values in (case.nfrc.family or {}).items():
        unit = unit_of(key, case.table or {})
        rows.append((with_unit(key, unit), first_few([f"{value}" for value in values])))
    return rows


def branch_log() -> Callable[["Branch", "Point"], None]:
    """Return a function that prints growing branches as a table, a line for a point, at most two lines per second."""
    # Points of reduced models follow each other in milliseconds: a line for each would scroll all else away.
    title = "branch           point      T (s)        E (J)  Newton  contacts  max multiplier\n"
    last = -math.inf

    def show(branch: "Branch", point: "Point") -> None:
        nonlocal title, last
        # Monotonic: setting the clock back must not silence the table.
        now = time.monotonic()
        if now - last < SHOW_EVERY:
            return
        logger.info(
            f"{title}{branch.name:<14} {point.index:7d} {point.period:10.4e} {point.energy:12.6e} {point.newton:7d}"
            f" {point.episodes:9d} {point.multiplier:15.6g}"
        )
        title = ""
        last = now

    return show


def branch_table(branch: "Branch") -> str:
    """Return the summary of a branch as text: length and range, special points, tongues, power laws of the slope."""
    from vipetsc.modes.branches.regions import slope_laws, tongues

    regular = branch.regular()
    lines = [f"{branch.name}: {counted(len(regular), 'point')}; {branch.ended.sentence}"]
    if regular:
        energy = branch.column("energy")
        frequency = branch.column("frequency")
        residual = max(point.residual for point in regular)
        lines.append(
            f"  E {energy.min():.6g} to {energy.max():.6g} J, f {frequency.min():.9g} to {frequency.max():.9g} Hz,"
            f" largest residual {residual:.1e}"
        )

    special = [point for point in branch.points if point.kind != "regular"]
    for kind in sorted({point.kind for point in special}):
        of_kind = [point for point in special if point.kind == kind]
        lines.append(f"  {kind}: {len(of_kind)}")
        lines += [f"    E = {point.energy:.12g} J, f = {point.frequency:.11g} Hz" for point in of_kind[:MOST_SPECIAL]]

    passed = tongues(branch)
    if passed:
        lines.append(
            f"  {counted(len(passed), 'tongue')} of internal resonances: {', '.join(f'{k}:1' for k in passed)}"
        )
    for region, law in slope_laws(branch).items():
        lines.append(
            f"  region {region}: df/dE ~ E^{law['exponent']:.4f}, adjusted R^2 {law['adjusted_r2']:.5f}"
            f" ({law['points']} points)"
        )
    return "\n".join(lines)


def parameter_unit(case: NfrcCase, curve: "Branch") -> str:
    """Return the unit of the parameter over which a ``curve`` of the case runs."""
    options = case.nfrc
    if options.varies_key:
        return str(curve.about["unit"])
    if options.over == "frequency":
        return "rad/s"
    # The amplitude of a wave counts in clearances of the first site, that of a drive in N or, of a wall, in m.
    if options.source == "wave":
        return "clearances"
    return drive_unit(case.drive)


def curve_rows(case: NfrcCase, curve: "Branch") -> Rows:
    """Return summary of a curve as rows: length, special points, jumps of slow sweeps, stability, energy balance."""
    from vipetsc.modes.branches.sweeps import measure, parameter_values, sweep_down, sweep_up

    options = case.nfrc
    rows = [("curve", curve.name), ("points", f"{len(curve.points)}; {curve.ended.sentence}")]
    if not curve.points:
        return rows

    unit = parameter_unit(case, curve)
    parameter = parameter_values(curve)
    if "special" in curve.about:
        cusps = [point.measured for point in curve.points if point.kind == "cusp"]
        ends = (f"{cusp.frequency:.6g} rad/s at amplitude {cusp.amplitude:.6g}" for cusp in cusps)
        return [*rows, ("cusps", ", ".join(ends) or "none")]
    for kind, heading in SPECIAL_POINTS.items():
        at = parameter[curve.is_kind(kind)]
        if at.size:
            rows.append((heading, ", ".join(f"{value:.6g}" for value in at) + f" {unit}"))
        elif kind == "fold":
            rows.append((heading, "none"))

    # Points at chosen values: quantity@value.
    for kind in dict.fromkeys(point.kind for point in curve.points if "@" in point.kind):
        at = parameter[curve.is_kind(kind)]
        rows.append((kind, ", ".join(f"{value:.6g}" for value in at) + f" {unit}"))

    jumps = []
    for direction, path in (("up", sweep_up(curve)), ("down", sweep_down(curve))):
        # The numbers of the states along a slow sweep go up or down one by one, unless the sweep jumps.
        jumps += [f"{parameter[a]:.5g} {direction}" for a, b in itertools.pairwise(path) if abs(a - b) > 1]
    rows.append(("jumps", ", ".join(jumps) or "none"))

    unstable = measure(curve, "unstable")
    rows.append(("stable", f"{np.sum(unstable == 0)} of {len(unstable)} points"))
    undecided = int(np.sum(unstable < 0))
    if undecided:
        remedy = f"more than nfrc.harmonics = {options.harmonics} may decide them"
        if options.truncation is not None:
            remedy = f"a smaller nfrc.truncation than {options.truncation:g}, or more nfrc.harmonics, may decide them"
        rows.append(("undecided", f"{counted(undecided, 'point')}; {remedy}"))
    if options.infinite:
        # The balance of energies is none of the equations that were solved, and so checks the whole computation.
        error = np.nanmax(np.abs(measure(curve, "share").sum(axis=1) - 1))
        rows.append(("T + R + U + L - 1", f"{error:.1e}"))
    return rows


def hold_branches(folders: Sequence[Path]) -> bool:
    """Return whether all folders hold branches; those of one name share a page."""
    return all(any(folder.glob("branch-*.h5")) and not (folder / "run.h5").exists() for folder in folders)


PICTURES = Pictures(BRANCHES, recognise=hold_branches)

NNM = StudyVerb(
    name="nnm",
    text="compute nonlinear normal modes as frequency-energy branches",
    example="nnm runs/examples/nnm-hertz.toml --quiet --log nnm.log",
    arguments=(case_with("nnm"), *STUDY_ARGUMENTS),
    case=NnmCase,
    study=follow_modes,
    table=nnm_rows,
    results=BRANCHES,
    pictures=PICTURES,
)

NFRC = StudyVerb(
    name="nfrc",
    text="compute steady states under a wave or a force, and their stability",
    example="nfrc runs/examples/nfrc.toml",
    arguments=(CASE, *STUDY_ARGUMENTS),
    case=NfrcCase,
    study=follow_responses,
    table=nfrc_rows,
    results=BRANCHES,
    pictures=PICTURES,
)
