"""One member of a sweep, all in: simulated, measured and recorded by the sweep itself; and the paper's budget."""

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
# Four more members take a second together, which is measured to a few per cent.
MEMBERS = 4


@dataclass(frozen=True)
class Kind:
    """A sweep of the paper's: its case file, what is changed in its tables, and an amplitude with many contacts."""

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
    """CPU seconds of a whole sweep over so many amplitudes, which lie close together: members cost the same."""
    table = tomllib.loads((EXAMPLES / kind.file).read_text(encoding="utf-8")) | {"name": folder.name}
    for section, changes in kind.changes.items():
        table[section] = table.get(section, {}) | changes
    # Equal amplitudes would be one member; so close, all have the same contacts and cost the same.
    amplitudes = [kind.amplitude * (1 + 1e-4 * k) for k in range(members)]
    table["sweep"] = {"measures": list(kind.measures), "drive": {"amplitude": amplitudes}}

    # Only now: reading the case file is no part of a member.
    begin = time.process_time()
    result = run_sweep(Sweep.from_table(table), folder, MPI.COMM_SELF)
    # A failed member ends early and would pass for a fast one.
    if not result.complete:
        raise RuntimeError(f"a member of {kind.file} failed: {result.status.tolist()}")
    return time.process_time() - begin


def member_seconds(folder: Path, rounds: int) -> dict[str, float]:
    """CPU seconds of one more member of a sweep: what ``1 + MEMBERS`` take more than one, median of ``rounds``."""
    measured: dict[str, list[float]] = {name: [] for name in KINDS}
    for turn in range(rounds + 1):
        for name, seconds in measured.items():
            # In the difference the linear run that members share, set-up and the final file cancel.
            one = _sweep_seconds(KINDS[name], 1, folder / f"{name}-{turn}-one")
            many = _sweep_seconds(KINDS[name], 1 + MEMBERS, folder / f"{name}-{turn}-many")
            if turn:  # the first one fills caches
                seconds.append((many - one) / MEMBERS)
    return {name: statistics.median(seconds) for name, seconds in measured.items()}


def paper_budget(folder: Path) -> dict[str, float]:
    """CPU seconds of the paper by stage, from what ``paper`` left in ``folder``; empty if it left nothing."""
    record = folder / "made.json"
    if not record.exists():
        return {}
    seconds = json.loads(record.read_text(encoding="utf-8")).get("cpu", {})
    # Steps of the study are stages like the figures and the report, which the record lists apart.
    stages = seconds.pop("steps", {}) | seconds
    return {name: float(value) for name, value in stages.items()}
