"""A model of the time on many ranks, from what one and two ranks measured; its assumptions stand below its table."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

# A core, a node, and sixteen nodes.
RANKS = (1, 64, 1024)
# Latency and bandwidth of the network of a common cluster.
LATENCY = 2e-6  # s a message
BANDWIDTH = 10e9  # bytes/s a rank
# The state of so many cells has some MB, which caches still hold; with fewer, messages cost a larger fraction.
WEAK = 100_000  # cells a rank
# On 1,024 ranks each rank has 10,000 of these, which is within the range that was measured here.
STRONG = 10_000_000  # cells in all


class ScalingModel:
    """A model of the seconds that an ``engine`` takes for a sample interval on many ranks.

    ``rows`` are those of ``bench_scaling.scaling``. The cells of a rank cost what one rank took here for as many,
    interpolated in logarithms, times ``shared``, the factor by which a rank is slower beside a second one on the same
    memory. A rank exchanges with two neighbours, one after the other, as many ``messages`` and ``bytes`` with each as
    two ranks exchanged here. Each of the ``reductions`` takes log2(ranks) messages in turn. Contacts are spread evenly
    over the ranks, and nothing overlaps. Raises ValueError unless the engine was measured on one rank and on two.
    """

    def __init__(self, rows: list[dict[str, Any]], engine: str) -> None:
        measured = [row for row in rows if row["engine"] == engine and "failure" not in row]
        measured.sort(key=lambda row: row["cells"])
        alone = [row for row in measured if row["ranks"] == 1]
        paired = [row for row in measured if row["ranks"] == 2]
        if not alone or not paired:
            raise ValueError(f"{engine} was not measured on one rank and on two")

        self._cells = [row["cells"] for row in alone]
        self._seconds = [row["wall_ms"] / 1e3 for row in alone]
        # The largest lattice exceeds the caches, and its ratio is used. A ratio below 1 would be noise.
        self.shared = max(1.0, 2 / paired[-1]["memory_speedup"])
        # The largest numbers of all lattices are used: the messages of a rank do not grow with its cells.
        self.messages = max(row["messages"] for row in paired)
        self.bytes = max(row["message_bytes"] for row in paired)
        self.reductions = max(row["reductions"] for row in paired)

    def compute(self, cells: float) -> float:
        """Seconds that one rank computes for so many ``cells``.

        Beyond the longest lattice that was measured they grow in proportion to the cells; below the shortest one they
        are its time, a bound from above.
        """
        largest = self._cells[-1]
        # The interpolation is in logarithms, because lengths and times span decades.
        within = np.exp(np.interp(np.log(min(cells, largest)), np.log(self._cells), np.log(self._seconds)))
        return float(within) * max(1.0, cells / largest) * self.shared

    def communicate(self, ranks: int) -> float:
        """Seconds that a rank among so many ``ranks`` sends, receives and reduces."""
        if ranks == 1:
            return 0.0
        # A rank exchanges with its left neighbour and then with the right one.
        exchange = 2 * (self.messages * LATENCY + self.bytes / BANDWIDTH)
        return exchange + self.reductions * math.ceil(math.log2(ranks)) * LATENCY

    def total(self, cells: float, ranks: int) -> float:
        """Seconds that so many ``ranks`` take for a lattice of ``cells`` in all."""
        return self.compute(cells / ranks) + self.communicate(ranks)


def _time_and_efficiency(seconds: float, efficiency: float) -> str:
    """An entry of the table: milliseconds, and the efficiency in per cent."""
    return f"{1e3 * seconds:.3g} ({100 * efficiency:.0f} %)"


def model_tables(rows: list[dict[str, Any]]) -> str:
    """Weak and strong scaling by the model, and its assumptions, in Markdown."""
    lines = []
    for engine in dict.fromkeys(row["engine"] for row in rows):
        try:
            model = ScalingModel(rows, engine)
        # An engine that was not measured on two ranks has no row; the other one still has.
        except ValueError:
            continue
        weak = []
        strong = []
        for ranks in RANKS:
            seconds = model.total(WEAK * ranks, ranks)
            weak.append(_time_and_efficiency(seconds, model.total(WEAK, 1) / seconds))
            seconds = model.total(STRONG, ranks)
            strong.append(_time_and_efficiency(seconds, model.total(STRONG, 1) / seconds / ranks))
        lines.append(f"| {engine} | weak, {WEAK:,} cells a rank | " + " | ".join(weak) + " |")
        lines.append(f"| {engine} | strong, {STRONG:,} cells in all | " + " | ".join(strong) + " |")
        lines.append(
            f"| {engine} | a rank and interval: {model.messages:.3g} messages and {model.bytes:.3g} bytes to each"
            f" neighbour, {model.reductions:.3g} reductions |" + " |" * len(RANKS)
        )
    if not lines:
        return ""

    head = "| engine | model: ms per 2e-4 s (efficiency) | " + " | ".join(f"{n} ranks" for n in RANKS) + " |"
    assumed = (
        f"Assumed: {1e6 * LATENCY:g} us a message, {BANDWIDTH / 1e9:g} GB/s a rank, log2(ranks) messages in turn a"
        " reduction, cells at what they cost here with both cores on the memory, contacts spread evenly, no overlap."
    )
    return "\n".join([head, "|---|---|" + "---|" * len(RANKS), *lines, "", assumed])
