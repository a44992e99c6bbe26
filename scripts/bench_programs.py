"""Whole programs as a user calls them, compared with an earlier version: time from the prompt to the last picture.

Calls of the two versions alternate, each in a process of its own, so that both meet the same state of the machine. The
earlier version is taken out of the repository's history; the package needs no build.
"""

from __future__ import annotations

import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
CASES = ROOT / "vipetsc" / "paper" / "cases"  # the same for both versions
# The earlier version.
BASELINE = "b03848f"
# The slowest program, a first run of the earlier version, compiles for a minute; ten leave room for a slow machine.
PATIENCE = 600  # seconds that one call may take

# Six amplitudes: at the lower ones there are no contacts, at the upper ones many.
SWEEP = """
name = "six"
[sweep]
measures = ["transfer", "entropy"]
[sweep.drive]
amplitude = [2.0, 6.0, 12.0, 18.0, 24.0, 30.0]
"""


@dataclass(frozen=True)
class Program:
    """A call of ``python -m vipetsc``: its ``words``, the number of ``ranks``, and whether it ``compiles`` kernels.

    ``{folder}`` in a word is the folder of the version that is measured, ``{cases}`` that of the paper's cases.
    ``--force`` lets a round replace the results of another.
    """

    words: str
    ranks: int = 1
    compiles: bool = False


PROGRAMS = {
    "help": Program("--help"),
    "validate": Program("validate"),
    "run without pictures, propagator": Program(
        "run --set time.engine=propagator --set output.figures=false --force --out {folder}/plain"
    ),
    # This call draws the results of the row before.
    "plot": Program("plot {folder}/plain"),
    "run with pictures, propagator": Program("run --set time.engine=propagator --force --out {folder}/propagator"),
    "run with pictures, ts": Program("run --set time.engine=ts --force --out {folder}/ts", ranks=2),
    "sweep of six": Program("sweep {folder}/six.toml --force --out {folder}/six"),
    # The largest steps of the paper at fewer amplitudes and wavenumbers: every third member is scaled, as there.
    "members of the step interband": Program(
        "sweep {cases}/interband.toml --set output.figures=false --set sweep.drive.amplitude=[1.0,100.0,1e4]"
        " --force --out {folder}/interband"
    ),
    "members of the step scattering": Program(
        "sweep {cases}/scattering.toml --set output.figures=false --set sweep.drive.amplitude=[0.1,1.5,20.0]"
        ' --set sweep.drive.wavenumber=["3pi/9","6pi/9"] --force --out {folder}/scattering'
    ),
    "first run, with compilation, propagator": Program(
        "run --set time.engine=propagator --set output.figures=false --force --out {folder}/first", compiles=True
    ),
}


@dataclass(frozen=True)
class Version:
    """A version of the package in ``source``, and the ``folder`` of its results."""

    source: Path
    folder: Path

    def seconds(self, program: Program) -> tuple[float, float]:
        """Return wall and CPU time in s of one call of ``program``; raises RuntimeError if the call fails."""
        # This process has initialised MPI: with its variables, a process that it starts would take itself for a rank.
        environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "PMIX", "OMPI_UNIVERSE"))}
        environment["PYTHONPATH"] = str(self.source)
        if program.compiles:
            # The cache of machine code is empty: kernels in the user's cache would not be compiled.
            kernels = self.folder / "kernels"
            shutil.rmtree(kernels, ignore_errors=True)
            environment["NUMBA_CACHE_DIR"] = str(kernels)

        words = program.words.format(folder=self.folder, cases=CASES).split()
        command = [sys.executable, "-m", "vipetsc", *words]
        if program.ranks > 1:
            command = ["mpirun", "-n", str(program.ranks), *command]

        # This is the time of children that have ended, with that of ranks, because mpirun waits for them.
        before = _cpu_seconds_of_children()
        begin = time.perf_counter()
        ended = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE
        )
        wall = time.perf_counter() - begin
        if ended.returncode:
            raise RuntimeError(f"{' '.join(words)} failed: {ended.stderr.strip()[-500:]}")
        return wall, _cpu_seconds_of_children() - before


def _cpu_seconds_of_children() -> float:
    """Return CPU seconds of all processes that this one has started and that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def unpack(commit: str, folder: Path) -> Path:
    """Write the package as of ``commit`` to a folder below ``folder``; returns that folder.

    Raises RuntimeError if the repository does not have the commit.
    """
    source = folder / commit
    # An earlier bench may have left it, and a commit does not change.
    if (source / "vipetsc").is_dir():
        return source

    archive = subprocess.run(["git", "-C", str(ROOT), "archive", commit, "vipetsc"], capture_output=True, check=False)
    if archive.returncode:
        raise RuntimeError(archive.stderr.decode().strip())
    # The package is unpacked under another name: a bench that is ended meanwhile leaves no incomplete package.
    aside = folder / f"{commit}.part"
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    subprocess.run(["tar", "-x", "-C", str(aside)], input=archive.stdout, check=True)
    aside.rename(source)
    return source


def programs(folder: Path, rounds: int, commit: str, names: Iterable[str]) -> list[dict]:
    """Measure the programs ``names`` in both versions; returns a row for each.

    A row has the medians over the rounds of wall and CPU times and of their ratios. A round before the first one fills
    caches and is not counted. A program that compiles runs once. Raises RuntimeError if the repository does not have
    the ``commit``.
    """
    source = unpack(commit, folder / "baseline")
    versions = {"before": Version(source, folder / "before"), "now": Version(ROOT, folder / "now")}
    for version in versions.values():
        version.folder.mkdir(parents=True, exist_ok=True)
        # Each version has a folder of its own: one must not find the results of the other and resume them.
        (version.folder / "six.toml").write_text(SWEEP, encoding="utf-8")

    rows = []
    for name in names:
        program = PROGRAMS[name]
        # The first turn, which loads files and kernels into memory, is not counted.
        first = 1
        turns = rounds
        # A program that compiles is measured with empty caches, and once, since it takes a minute.
        if program.compiles:
            first = 0
            turns = 1
        measured: dict[str, list[tuple[float, float]]] = {label: [] for label in versions}
        try:
            for turn in range(first + turns):
                for label, version in versions.items():
                    seconds = version.seconds(program)
                    if turn >= first:
                        measured[label].append(seconds)
        except (RuntimeError, subprocess.TimeoutExpired) as failure:
            # The table has a row for the failure, and the other programs are measured.
            rows.append({"program": name, "ranks": program.ranks, "failure": str(failure)})
            continue
        rows.append({"program": name, "ranks": program.ranks, "baseline": commit} | _summary(measured))
    return rows


def _summary(measured: dict[str, list[tuple[float, float]]]) -> dict:
    """Return medians over the rounds of wall and CPU seconds, of their ratios, and the range of the ratios."""
    before = np.array(measured["before"])
    now = np.array(measured["now"])
    # The speed of the machine changes during a bench, but cancels in ratios of calls that follow each other.
    ratios = now / before
    found = {}
    for column, kind in enumerate(("wall", "cpu")):
        found[f"{kind}_before"] = statistics.median(before[:, column])
        found[f"{kind}_now"] = statistics.median(now[:, column])
        found[f"{kind}_ratio"] = statistics.median(ratios[:, column])
        found[f"{kind}_range"] = [float(ratios[:, column].min()), float(ratios[:, column].max())]
    return found


def programs_table(rows: list[dict]) -> str:
    """Return the rows in Markdown."""
    # All rows have the same baseline, but rows of failures have none.
    commit = next((row["baseline"] for row in rows if "baseline" in row), BASELINE)
    lines = [
        f"| program | ranks | wall s at {commit} | now | ratio (range) | CPU s at {commit} | now | ratio (range) |",
        "|---" * 8 + "|",
    ]

    for row in rows:
        if "failure" in row:
            lines.append(f"| {row['program']} | {row['ranks']} | failed | | | | | |")
            continue

        cells = [row["program"], str(row["ranks"])]
        for kind in ("wall", "cpu"):
            low, high = row[f"{kind}_range"]
            cells += [f"{row[f'{kind}_before']:.2f}", f"{row[f'{kind}_now']:.2f}"]
            cells.append(f"{row[f'{kind}_ratio']:.2f} ({low:.2f} to {high:.2f})")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)
