"""CPU time of one member of a sweep, simulated, measured and recorded by the sweep itself, and of the whole paper."""

from __future__ import annotations

import json
import statistics
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.case import Sweep
from vipetsc.studies.sweep import run_sweep

EXAMPLES = Path(__file__).parents[1] / "vipetsc" / "examples"
# Members by which two sweeps differ: four take about a second together, which is measured to a few per cent.
MEMBERS = 4


@dataclass(frozen=True)
class Kind:
    """A sweep of the paper: its case ``file``, ``changes`` in its tables, what it ``measures``, and an ``amplitude``.

    At the amplitude, in N, there are many contacts.
    """

    file: str
    changes: dict[str, dict[str, Any]]
    measures: tuple[str, ...]
    amplitude: float


KINDS = {
    "four-band": Kind(
        "interband.toml",
        {"lattice": {"reading": "calibrated"}, "contacts": {"sites": 5}},
        ("transfer", "entropy"),
        24.33,
    ),
    "diatomic": Kind(
        "scattering.toml",
        {"lattice": {"reading": "calibrated"}, "contacts": {"sites": 5}, "drive": {"wavenumber": "5pi/9"}},
        ("entropy",),
        1.0,
    ),
}


def _sweep_seconds(kind: Kind, members: int, folder: Path) -> float:
    """Return CPU seconds of a sweep of so many ``members``, in ``folder``; raises RuntimeError if a member fails."""
    table = tomllib.loads((EXAMPLES / kind.file).read_text(encoding="utf-8")) | {"name": folder.name}
    for section, changes in kind.changes.items():
        table[section] = table.get(section, {}) | changes
    # Equal amplitudes would be one member. As close as these, members have the same contacts and cost the same.
    amplitudes = [kind.amplitude * (1 + 1e-4 * k) for k in range(members)]
    table["sweep"] = {"measures": list(kind.measures), "drive": {"amplitude": amplitudes}}

    # The time begins after the case file was read, which is no part of a member.
    begin = time.process_time()
    result = run_sweep(Sweep.from_table(table), folder, MPI.COMM_SELF)
    # A failed member ends early and would pass for a fast one.
    if not result.complete:
        raise RuntimeError(f"a member of {kind.file} failed: {result.status.tolist()}")
    return time.process_time() - begin


def member_seconds(folder: Path, rounds: int) -> dict[str, float]:
    """Return CPU seconds of one more member of a sweep, by the names in ``KINDS``, as the median of ``rounds``.

    It is the difference between sweeps of ``1 + MEMBERS`` members and of one, over ``MEMBERS``.
    """
    measured: dict[str, list[float]] = {name: [] for name in KINDS}
    for turn in range(rounds + 1):
        for name, seconds in measured.items():
            # The common linear run, the set-up and the final file cancel in the difference.
            one = _sweep_seconds(KINDS[name], 1, folder / f"{name}-{turn}-one")
            many = _sweep_seconds(KINDS[name], 1 + MEMBERS, folder / f"{name}-{turn}-many")
            # The first turn fills caches.
            if turn:
                seconds.append((many - one) / MEMBERS)
    return {name: statistics.median(seconds) for name, seconds in measured.items()}


def paper_budget(folder: Path) -> dict[str, float]:
    """Return CPU seconds of the paper by stage, from what ``paper`` left in ``folder``; empty if it left nothing."""
    record = folder / "made.json"
    if not record.exists():
        return {}
    seconds = json.loads(record.read_text(encoding="utf-8")).get("cpu", {})
    # The record lists the steps apart from the other stages, which are figures, claims and report.
    stages = seconds.pop("steps", {}) | seconds
    return {name: float(value) for name, value in stages.items()}
