"""What the verb ``nnm`` prints: a live table while a branch grows, and how it went."""

import math
import time
from typing import TextIO

from vipetsc.modes.branch import Branch
from vipetsc.modes.point import Point


class BranchLog:
    """The live table of a growing branch: a line a point, no more than two a second."""

    def __init__(self, stream: TextIO, interval: float = 0.5) -> None:
        self._stream, self._interval, self._last = stream, interval, -math.inf
        self._titled = False

    def __call__(self, branch: Branch, point: Point) -> None:
        """Show ``point`` of ``branch``, unless a point was shown a moment ago."""
        now = time.monotonic()
        if now - self._last < self._interval:
            return
        self._last = now
        if not self._titled:
            self._titled = True
            self._stream.write("branch           point      T (s)        E (J)  Newton  contacts  max multiplier\n")
        self._stream.write(
            f"{branch.name:<14} {point.index:7d} {point.period:10.4e} {point.energy:12.6e} {point.newton:7d}"
            f" {point.episodes:9d} {point.multiplier:15.6g}\n"
        )
        self._stream.flush()


def branch_table(branch: Branch) -> str:
    """How a branch went: length, range, special points, power laws, findings."""
    regular = branch.regular()
    lines = [f"{branch.name}: {len(regular)} points; {branch.ending}"]
    if regular:
        energy, frequency = branch.column("energy"), branch.column("frequency")
        residual = max(p.residual for p in regular)
        lines.append(
            f"  E {energy.min():.6g} to {energy.max():.6g} J, f {frequency.min():.9g} to {frequency.max():.9g} Hz,"
            f" largest residual {residual:.1e}"
        )
    special = [p for p in branch.points if p.kind != "regular"]
    for kind in sorted({p.kind for p in special}):
        of_kind = [p for p in special if p.kind == kind]
        lines.append(f"  {kind}: {len(of_kind)}")
        lines += [f"    E = {p.energy:.12g} J, f = {p.frequency:.11g} Hz" for p in of_kind[:4]]
    for region, law in branch.fits().items():
        lines.append(
            f"  region {region}: df/dE ~ E^{law['exponent']:.4f}, adjusted R^2 {law['adjusted_r2']:.5f}"
            f" ({law['points']} points)"
        )
    return "\n".join(lines + [f"  ! {finding}" for finding in branch.findings])
