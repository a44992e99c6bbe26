"""Goals of a bench: a few named numbers and their targets, from ``latest.json`` alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from bench_programs import PROGRAMS


@dataclass(frozen=True)
class Target:
    """A measured ``value``, and the ``target`` that it should reach: at least, or, if not ``at_least``, at most."""

    name: str
    value: float
    target: float
    at_least: bool = True

    @property
    def met(self) -> bool:
        """Whether the value reaches the target."""
        if self.at_least:
            return self.value >= self.target
        return self.value <= self.target


def targets(found: dict[str, Any]) -> list[Target]:
    """The goals of which ``found``, the content of ``latest.json``, has the numbers, in the order of its parts."""
    return [
        *_against_peers(found),
        *_scaling(found.get("scaling", [])),
        *_whole_programs(found.get("programs", [])),
        *_studies(found),
    ]


def _against_peers(found: dict[str, Any]) -> list[Target]:
    """Ratios of CPU time at equal error."""
    wanted = (
        ("propagator faster than odeint dopri5 at error 1e-8", "odeint dopri5 / vipetsc propagator at 1e-08", 20.0),
        ("ts faster than plain TSRK 8vr at error 1e-8", "TSRK 8vr / vipetsc ts at 1e-08", 1.0),
    )
    ratios = found.get("ratios", {})
    return [Target(f"{name} (times)", ratios[key], least) for name, key, least in wanted if key in ratios]


def _scaling(rows: list[dict[str, Any]]) -> list[Target]:
    """Speed of large lattices, which the memory's bandwidth bounds, and gains of a second rank."""
    rows_by_case = {(row["engine"], row["cells"], row["ranks"]): row for row in rows if "failure" not in row}
    found = []
    for cells in (10**5, 10**6):
        one = rows_by_case.get(("propagator", cells, 1))
        if one:
            # 0.3, since a method that passes over the state three times an interval reaches a third of the limit.
            fraction = one["fraction_of_bandwidth_limit"]
            found.append(Target(f"propagator: fraction of the memory's limit at {cells:,} cells", fraction, 0.3))
        two = rows_by_case.get(("propagator", cells, 2), {})
        if "speedup" in two:
            # Two ranks share one memory, whose bandwidth a second core does not double. Nine tenths of what it gains
            # must arrive.
            gain = two["speedup"] / two["memory_speedup"]
            found.append(Target(f"gain of a second rank over that of bare memory at {cells:,} cells", gain, 0.9))

    # At 300 cells a rank has little to compute, and messages must not cost more than a second rank saves.
    two = rows_by_case.get(("propagator", 300, 2), {})
    if "speedup" in two:
        found.append(Target("two ranks against one at 300 cells (times as fast)", two["speedup"], 1.0))
    one = rows_by_case.get(("ts", 30_000, 1))
    if one:
        found.append(Target("ts at 30,000 cells, ms of CPU per 2e-4 s", one["cpu_ms"], 20.0, at_least=False))
    return found


def _whole_programs(rows: list[dict[str, Any]]) -> list[Target]:
    """Times of whole programs relative to those of the earlier version."""
    measured = []
    for row in rows:
        program = PROGRAMS[row["program"]]
        # A failed program has no time; its row in the table of programs says so.
        if "failure" in row or program.target is None:
            continue
        kind = "wall"
        if program.by_cpu:
            kind = "cpu"
        name = f"{row['program']}, {kind} time over that of {row['baseline']}"
        measured.append(Target(name, row[f"{kind}_ratio"], round(program.target, 2), at_least=False))
    return measured


def _studies(found: dict[str, Any]) -> list[Target]:
    """CPU time of a sweep's member, and of the whole paper."""
    # Targets by kind: the seconds of a member when targets were set. The paper's two largest stages are such sweeps.
    most = {"four-band": 0.35, "diatomic": 0.25}
    measured = []
    for kind, seconds in found.get("members", {}).items():
        measured.append(Target(f"{kind} member, CPU s", seconds, most[kind], at_least=False))
    budget = found.get("paper")
    if budget:
        measured.append(Target("paper, CPU s", sum(budget.values()), 450.0, at_least=False))
    return measured


def table(found: dict[str, Any]) -> str:
    """The goals with their numbers and targets as a table in Markdown; empty if none was measured."""
    measured = targets(found)
    if not measured:
        return ""

    lines = ["| goal | measured | target | met |", "|---|---|---|---|"]
    for one in measured:
        sign = ">=" if one.at_least else "<="
        met = "yes" if one.met else "no"
        lines.append(f"| {one.name} | {one.value:.3g} | {sign} {one.target:g} | {met} |")
    return "\n".join(lines)
