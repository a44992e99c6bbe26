"""What a bench must show: a few named numbers beside their targets, from ``latest.json`` alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Target:
    """A number and what it should be at least, or at most."""

    name: str
    value: float
    target: float
    at_least: bool = True

    @property
    def met(self) -> bool:
        """Whether the number is as it should be."""
        return self.value >= self.target if self.at_least else self.value <= self.target


def targets(found: dict[str, Any]) -> list[Target]:
    """The numbers that were measured, in the order of the parts."""
    return [*_against_peers(found), *_of_the_memory(found.get("scaling", [])), *_of_sweeps(found)]


def _against_peers(found: dict[str, Any]) -> list[Target]:
    wanted = (
        ("propagator faster than odeint dopri5 at error 1e-8", "odeint dopri5 / vipetsc propagator at 1e-08", 20.0),
        ("ts faster than plain TSRK 8vr at error 1e-8", "TSRK 8vr / vipetsc ts at 1e-08", 1.0),
    )
    ratios = found.get("ratios", {})
    return [Target(f"{name} (times)", ratios[key], least) for name, key, least in wanted if key in ratios]


def _of_the_memory(rows: list[dict[str, Any]]) -> list[Target]:
    by_case = {(row["engine"], row["cells"], row["ranks"]): row for row in rows if "failure" not in row}
    made = []
    for cells in (10**5, 10**6):
        if one := by_case.get(("propagator", cells, 1)):
            share = one["share_of_bandwidth_limit"]
            made.append(Target(f"propagator's share of the memory's limit at {cells:,} cells", share, 0.3))
        if (two := by_case.get(("propagator", cells, 2))) and "speedup" in two:
            gain = two["speedup"] / two["memory_speedup"]
            made.append(Target(f"second rank's gain over the memory's at {cells:,} cells", gain, 0.9))
    if (two := by_case.get(("propagator", 300, 2))) and "speedup" in two:
        made.append(Target("two ranks against one at 300 cells (times as fast)", two["speedup"], 1.0))
    if one := by_case.get(("ts", 30_000, 1)):
        made.append(Target("ts at 30,000 cells, ms of CPU per 2e-4 s", one["cpu_ms"], 20.0, at_least=False))
    return made


def _of_sweeps(found: dict[str, Any]) -> list[Target]:
    most = {"four-band": 0.35, "diatomic": 0.25}
    made = [
        Target(f"{kind} member, CPU s", seconds, most[kind], at_least=False)
        for kind, seconds in found.get("members", {}).items()
    ]
    if budget := found.get("paper"):
        made.append(Target("paper, CPU s", sum(budget.values()), 650.0, at_least=False))
    return made


def table(found: dict[str, Any]) -> str:
    """The numbers beside their targets in Markdown; empty if none was measured."""
    made = targets(found)
    if not made:
        return ""
    lines = ["| it must show | measured | target | |", "|---|---|---|---|"]
    for one in made:
        sign = ">=" if one.at_least else "<="
        lines.append(f"| {one.name} | {one.value:.3g} | {sign} {one.target:g} | {'yes' if one.met else 'no'} |")
    return "\n".join(lines)
