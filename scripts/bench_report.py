"""Tables in Markdown and pictures of a bench, from ``latest.json`` alone."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
from bench_precision import ERRORS, at_equal_error
from bench_programs import programs_table
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vipetsc.figures import style
from vipetsc.io.atomic import atomic_write

# Circles are this package's engines, squares methods of order 5, triangles those of order 8, diamonds SciPy's.
_LOOKS = {
    "vipetsc propagator": (style.VERMILION, "o", "-"),
    "vipetsc ts": (style.BLUE, "o", "-"),
    "odeint dopri5": (style.BLACK, "s", "-"),
    "odeint fehlberg78": (style.BLACK, "^", ":"),
    "ARKODE dopri5": (style.SKY, "s", "-."),
    "diffrax Dopri8": (style.ORANGE, "^", "-"),
    "TSRK 5dp": (style.GREEN, "s", "--"),
    "TSRK 8vr": (style.GREEN, "^", "--"),
    "DOP853 numba": (style.PURPLE, "D", "-."),
    "DOP853 numpy": (style.ORANGE, "D", "-."),
}
_OTHER = (style.GREY, "v", "-")


def solver_names(found: dict[str, Any]) -> list[str]:
    """Return the solvers in ``found``, in the order in which they were measured."""
    return list(dict.fromkeys(row["solver"] for row in found["rows"]))


def curve(found: dict[str, Any], solver: str) -> list[tuple[float, float]]:
    """Return errors and CPU seconds of one solver by falling tolerance, without failures and the reference."""
    return [(r["error"], r["seconds"]) for r in found["rows"] if r["solver"] == solver and r["error"]]


def markdown(found: dict[str, Any]) -> str:
    """Return all tables for which ``found`` has numbers, as Markdown: CPU time at equal error, programs, scaling."""
    parts = {
        "provenance": _origin_table,
        "rows": _precision_table,
        "reference": _reference_table,
        "whole": _whole_table,
        "programs": lambda measured: programs_table(measured["programs"]),
        "members": _members_table,
        "paper": _paper_table,
        "scaling": _scaling_table,
        "builds": _builds_table,
    }
    # A bench of some parts has no tables of the others.
    sections = [part(found) for key, part in parts.items() if found.get(key)]
    return "\n\n".join(sections) + "\n"


def _origin_table(found: dict[str, Any]) -> str:
    """Return when the bench was made, of which version, on which machine and with which libraries."""
    origin = found["provenance"]
    rows = {
        "date": origin["date"][:10],
        "version": origin["revision"],
        "processor": f"{processor()}, {os.cpu_count()} cores",
        "parts": ", ".join(found["parts"]),
        "rounds": f"{found['rounds']} ({found['mode']})",
        "libraries": f"PETSc {origin['petsc_version']}, {origin['mpi_version']}, numpy {origin['numpy_version']}",
    }
    return "\n".join(["| measured | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def processor() -> str:
    """Return the name of the processor, on Linux; elsewhere that of the architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _precision_table(found: dict[str, Any]) -> str:
    """Return CPU seconds of all solvers at equal error, and their ratios to the propagator's, or to those of ``ts``."""
    names = solver_names(found)
    # The last engine of this package: the propagator, which is faster than ts where it applies.
    engine = [name for name in names if name.startswith("vipetsc")][-1]
    reference = found["reference"]
    lines = [
        f"| CPU seconds (ratio to {engine}) at error | " + " | ".join(_power(e) for e in ERRORS) + " |",
        "|---|" + "---|" * len(ERRORS),
    ]

    for name in names:
        cells = []
        for wanted in ERRORS:
            seconds = None
            # Below the floor the references differ by as much.
            if wanted >= reference["floor"]:
                seconds = at_equal_error(curve(found, name), wanted, bound=name.startswith("vipetsc"))
            ratio = found["ratios"].get(f"{name} / {engine} at {wanted:g}")
            cells.append(_seconds_and_ratio(seconds, ratio))
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _reference_table(found: dict[str, Any]) -> str:
    """Return how far other solvers at the edge of double precision lie from the reference."""
    reference = found["reference"]
    lines = [f"| reference: {reference['solver']}, to {reference['end']:g} s | distance from it |", "|---|---|"]
    lines += [f"| {name} | {value:.1e} |" for name, value in reference["separation"].items()]
    return "\n".join(lines)


def _seconds_and_ratio(seconds: float | None, ratio: float | None) -> str:
    """Return an entry of the table: CPU seconds, with the ratio if there is one; "-" for none."""
    if seconds is None:
        return "-"
    if ratio:
        return f"{seconds:.3g} ({ratio:.3g})"
    return f"{seconds:.3g}"


def _whole_table(found: dict[str, Any]) -> str:
    """Return CPU time of the built-in case inside a program that has started, and of a right-hand side."""
    lines = ["| inside the program | CPU time |", "|---|---|"]
    for engine, seconds in found["whole"].items():
        lines.append(f"| built-in case up to `run.h5`, {engine} | {seconds:.2f} s |")
    size = found["degrees_of_freedom"]
    lines.append(f"| right-hand side of {size} masses through PETSc | {found['right_hand_side_us']:.2g} us |")
    return "\n".join(lines)


def _members_table(found: dict[str, Any]) -> str:
    """Return CPU time of one more member of a sweep."""
    lines = ["| one more member of a sweep | CPU s |", "|---|---|"]
    lines += [f"| {kind} | {seconds:.3g} |" for kind, seconds in found["members"].items()]
    return "\n".join(lines)


def _paper_table(found: dict[str, Any]) -> str:
    """Return CPU time of the paper over all ranks, by stage, the longest first."""
    budget = found["paper"]
    lines = ["| stage of the paper | CPU s of all ranks |", "|---|---|", f"| all | {sum(budget.values()):.0f} |"]
    for stage, seconds in sorted(budget.items(), key=lambda item: -item[1]):
        lines.append(f"| {stage} | {seconds:.0f} |")
    return "\n".join(lines)


def _builds_table(found: dict[str, Any]) -> str:
    """Return set-up and files of large lattices."""
    lines = [
        "| cells | sites | ranks | set-up (s) | velocities written (GB) | in (s) | peak GiB a rank |",
        "|---" * 7 + "|",
    ]
    for row in found["builds"]:
        lattice = f"{row['cells']:,} | {row['sites']:,} | {row['ranks']}"
        if "failure" in row:
            lines.append(f"| {lattice} | failed | | | |")
            continue
        written = f"{row['file_gb']:.2g} | {row['write_s']:.2g}"
        lines.append(f"| {lattice} | {row['set_up_s']:.2g} | {written} | {row['peak_gib_a_rank']:.2f} |")
    return "\n".join(lines)


def _scaling_table(found: dict[str, Any]) -> str:
    """Return wall time and memory over cells and ranks."""
    lines = [
        "| engine | cells | ranks | ms per 2e-4 s | two ranks gain (bare memory gains) | peak GiB a rank"
        " | fraction of bandwidth limit |",
        "|---|---|---|---|---|---|---|",
    ]

    for row in found["scaling"]:
        if "failure" in row:
            lines.append(f"| {row['engine']} | {row['cells']:,} | | failed | | | |")
            continue
        # Two ranks are compared with one, whose own row has no gain.
        gain = ""
        if "speedup" in row:
            gain = f"{row['speedup']:.2f} ({row['memory_speedup']:.2f})"
        lines.append(
            f"| {row['engine']} | {row['cells']:,} | {row['ranks']} | {row['wall_ms']:.3g} | {gain}"
            f" | {row['peak_gib_a_rank']:.2f} | {100 * row['fraction_of_bandwidth_limit']:.2g} % |"
        )
    return "\n".join(lines)


def _power(value: float) -> str:
    """Return a power of ten as ``1e-8``, not ``1e-08``."""
    return f"{value:.0e}".replace("e-0", "e-")


def draw(found: dict[str, Any], folder: Path) -> list[Path]:
    """Draw ``work-precision.png`` and ``scaling.png`` to ``folder``, if they were measured; returns the files."""
    pictures = {"rows": ("work-precision", work_precision_figure), "scaling": ("scaling", scaling_figure)}
    # Rows of failures are left out: they have no numbers to draw.
    found = found | {"scaling": [row for row in found.get("scaling", []) if "failure" not in row]}
    paths = []
    for key, (name, make) in pictures.items():
        if found.get(key):
            path = folder / f"{name}.png"
            with style.rc_style(), atomic_write(path) as aside:
                make(found).savefig(aside, format="png")
            paths.append(path)
    return paths


def work_precision_figure(found: dict[str, Any]) -> Figure:
    """Return a figure of the CPU seconds over the relative error of all sampled velocities, for each solver."""
    figure = style.new_figure(4.6, 3.0)
    axes = figure.subplots()
    for name in solver_names(found):
        points = np.array(curve(found, name))
        if points.size:
            colour, marker, line = _LOOKS.get(name, _OTHER)
            axes.loglog(*points.T, line, color=colour, marker=marker, ms=3, label=name)

    # Errors below the distance of the references may be those of the references.
    floor = max(found["reference"]["separation"].values())
    left = min(axes.get_xlim()[0], floor / 5)
    axes.axvspan(left, floor, color=style.PALE, lw=0)
    axes.set_xlim(left=left)
    axes.text(np.sqrt(left * floor), 0.03, "references differ", ha="center", va="bottom", rotation=90, fontsize=6,
              color=style.GREY, transform=axes.get_xaxis_transform())  # fmt: skip

    axes.set_xlabel("relative error of the sampled velocities")
    axes.set_ylabel("CPU time (s)")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))
    axes.set_title(f"{found['cells']} cells, {found['reference']['end']:g} s, one core")
    return figure


def scaling_figure(found: dict[str, Any]) -> Figure:
    """Return a figure of wall time and memory over the number of cells, for each engine on one rank and on two."""
    figure = style.new_figure(style.PAGE, 2.6)
    left, right = figure.subplots(1, 2)
    for engine in dict.fromkeys(row["engine"] for row in found["scaling"]):
        colour, marker, _ = _LOOKS.get(f"vipetsc {engine}", _OTHER)
        for ranks, line, words in ((1, "-", "1 rank"), (2, "--", "2 ranks")):
            rows = [r for r in found["scaling"] if r["engine"] == engine and r["ranks"] == ranks]
            cells = [r["cells"] for r in rows]
            label = f"{engine}, {words}"
            left.loglog(cells, [r["wall_ms"] for r in rows], line, color=colour, marker=marker, ms=3, label=label)
            right.semilogx(cells, [r["peak_gib_a_rank"] for r in rows], line, color=colour, marker=marker, ms=3)

    _limit(left, found["scaling"])
    # The axis begins at zero, so that heights are in proportion to memory.
    right.set_ylim(0, 1.15 * max(row["peak_gib_a_rank"] for row in found["scaling"]))
    left.set_ylabel("wall time per 2e-4 s of model time (ms)")
    right.set_ylabel("peak memory a rank (GiB)")
    for axes, title in ((left, "(a) time"), (right, "(b) memory")):
        axes.set_xlabel("cells")
        axes.set_title(title)
    right.legend(*left.get_legend_handles_labels(), loc="center left", bbox_to_anchor=(1.01, 0.5))
    return figure


def _limit(axes: Axes, rows: list[dict]) -> None:
    """Draw the time in which one rank reads and writes the state once, at the bandwidth of its memory."""
    # This is a bound of the machine: the rows of one engine are enough.
    first = [r for r in rows if r["ranks"] == 1 and r["engine"] == rows[0]["engine"]]
    limit = [r["wall_ms"] * r["fraction_of_bandwidth_limit"] for r in first]
    axes.loglog([r["cells"] for r in first], limit, ":", color=style.GREY, label="memory alone, 1 rank")
