"""The verb ``bands``: pass bands, gaps and group velocities of a cell, and linear modes of the finite lattice."""

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vipetsc.case import Case, CaseError, Problem
from vipetsc.cli.arguments import CASE, OUT, SET, argument
from vipetsc.cli.messages import echo
from vipetsc.cli.verb import DONE, PlainVerb, default_folder
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import origin
from vipetsc.io.lock import locked
from vipetsc.lattice import UnitCell, gaps, max_group_velocity, modes_of_a_cell, pass_bands, wave_bands
from vipetsc.lattice.damped import damped_bloch, decay_length
from vipetsc.parallel import ALONE, StopRequest, on_root

if TYPE_CHECKING:
    from mpi4py import MPI

MODES = argument(
    "--modes",
    type=int,
    metavar="N",
    help="also compute N linear modes of the finite lattice, those nearest to a frequency, and their shapes",
)
NEAR = argument("--near", type=float, metavar="OMEGA", help="frequency in rad/s for --modes; default: 0")
JSON = argument("--json", action="store_true", help="print JSON instead of a table")


def bands(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Print pass bands, gaps and group velocities of a case's cell, and write them as a table and a picture."""
    case = on_root(comm, lambda: Case.load(options.case, options.set))
    folder = options.out or default_folder(case.name, "bands")

    # All ranks find modes together; everything else is a second's work for one.
    modes = modes_report(case, options, folder, comm)
    text = on_root(comm, lambda: write_bands(case, folder, options.json))
    # JSON is read by programs, for which modes are in their file.
    if not options.json:
        text += modes
    echo(comm, text)
    return DONE


def write_bands(case: Case, folder: Path, as_json: bool) -> str:
    """Write ``bands.json`` and ``bands.png`` to ``folder``; returns what is printed. Called on one rank."""
    from vipetsc.figures.registry import draw_bands

    cell = case.lattice.unit_cell()
    numbers = bands_table(cell) | damping_table(cell, case.wave_frequency or 0.0)
    # The lock has the communicator of this rank, the only one here: with another it would wait for all ranks.
    with locked(ALONE, folder):
        picture: dict[str, str] = {}
        if cell.joins_cells:
            drawn = draw_bands(cell, folder / "bands.png", case.wave_frequency, case.lattice.section_of_strip)
            picture["picture"] = str(drawn)
        text = json.dumps(numbers | picture | origin(), indent=2)
        write_text(folder / "bands.json", text + "\n")

    if as_json:
        return text
    if not cell.joins_cells:
        return without_bands(cell)
    return f"{bands_report(numbers)}{damping_report(numbers)}\n  {picture['picture']}"


def without_bands(cell: UnitCell) -> str:
    """Return the sentence on a cell that contacts alone join to others, with the modes that its springs give it."""
    if not cell.springs:
        return "no pass bands: only contacts join the masses, so that there are no linear waves"
    modes = ", ".join(f"{frequency:.2f}" for frequency in modes_of_a_cell(cell))
    return (
        "no pass bands: only contacts join the cells, so that no linear wave travels from one to the next; each cell"
        f" has the modes {modes} rad/s for itself"
    )


def bands_table(cell: UnitCell) -> dict[str, Any]:
    """Return the bands of a cell, with edges and fastest waves, and the gaps, as for JSON; with their ``units``.

    A cell that contacts alone join to others has neither bands nor gaps. If there are springs in it, the frequencies of
    the cell alone are its ``cell_modes``.
    """
    edges = wave_bands(cell)
    alone: dict[str, Any] = {}
    if cell.springs and not cell.joins_cells:
        alone["cell_modes"] = modes_of_a_cell(cell).tolist()

    rows = []
    for band in edges:
        kappa, frequency, speed = max_group_velocity(cell, band.number)
        fastest = {"wavenumber": kappa, "frequency": frequency, "group_velocity": speed}
        rows.append({"band": band.number, "low": band.low, "high": band.high, "max_group_velocity": fastest})

    return {
        "units": {"frequency": "rad/s", "group_velocity": "cells/s", "wavenumber": "rad/cell"},
        "bands": rows,
        "gaps": [{"low": low, "high": high} for low, high in gaps(edges)],
        **alone,
    }


def bands_report(numbers: dict[str, Any]) -> str:
    """Return ``bands_table`` as text."""
    lines = ["band       low      high  rad/s    fastest: kappa/pi   rad/s   cells/s"]
    for row in numbers["bands"]:
        fastest = row["max_group_velocity"]
        lines.append(
            f"{row['band']:4d} {row['low']:9.2f} {row['high']:9.2f}           "
            f"{fastest['wavenumber'] / np.pi:16.4f} {fastest['frequency']:8.2f} {fastest['group_velocity']:8.2f}"
        )
    lines += [f" gap {gap['low']:9.2f} {gap['high']:9.2f}" for gap in numbers["gaps"]]
    return "\n".join(lines)


def damping_table(cell: UnitCell, frequency: float) -> dict[str, Any]:
    """Return damping of a cell as for JSON: of each band's fastest wave, and decay lengths at ``frequency`` in rad/s.

    ``damping`` has the damping ratio, the damped frequency in rad/s and the time in s to decay to 1/e of each wave,
    ``decay_length`` the number of ``cells`` to 1/e of the wave that goes farthest. A time or a length without end is
    None, since JSON has no infinite numbers. The table is empty for a cell without dashpots or without bands.
    """
    if not (cell.is_damped and cell.joins_cells):
        return {}

    rows = []
    for band in pass_bands(cell):
        kappa = max_group_velocity(cell, band.number)[0]
        point = damped_bloch(cell, kappa)
        rate = point.rate[band.number - 1]
        decay_time = None
        if rate.real:
            # Amplitudes go as exp(rate t), with a negative real part.
            decay_time = float(-1 / rate.real)
        rows.append({
            "band": band.number,
            "wavenumber": kappa,
            "damping_ratio": float(point.ratio[band.number - 1]),
            "frequency": float(rate.imag),
            "decay_time": decay_time,
        })  # fmt: skip

    length: float | None = decay_length(cell, frequency)
    if length == np.inf:
        length = None
    return {"damping": rows, "decay_length": {"frequency": frequency, "cells": length}}


def damping_report(numbers: dict[str, Any]) -> str:
    """Return ``damping_table`` as text; empty for a cell without dashpots."""
    if "damping" not in numbers:
        return ""

    lines = ["\nband  damping ratio  decays to 1/e in (s)   at: kappa/pi   rad/s"]
    for row in numbers["damping"]:
        decay_time = "never"
        if row["decay_time"] is not None:
            decay_time = f"{row['decay_time']:.4g}"
        lines.append(
            f"{row['band']:4d} {row['damping_ratio']:14.4g} {decay_time:>21} "
            f"{row['wavenumber'] / np.pi:14.4f} {row['frequency']:8.2f}"
        )

    length = numbers["decay_length"]
    decay = "do not decay"
    if length["cells"] is not None:
        decay = f"decay to 1/e in {length['cells']:.4g} cells"
    lines.append(f"at {length['frequency']:.6g} rad/s waves {decay}")
    return "\n".join(lines)


def modes_report(case: Case, options: argparse.Namespace, folder: Path, comm: "MPI.Comm") -> str:
    """Find the linear modes that ``--modes`` asks for, and write them to ``folder``; returns text about them on rank 0.

    The text is empty if none are requested, and on the other ranks. Collective. Raises CaseError for options that do
    not fit together.
    """
    if options.modes is None:
        if options.near is not None:
            raise CaseError([Problem("--near", options.near, "gives the frequency for --modes; give both options")])
        return ""

    from vipetsc.studies import linear_modes

    with locked(comm, folder):
        data = linear_modes.find_modes(case, options.modes, options.near or 0.0, folder, comm)
    # The modes are on rank 0 alone, whose text is printed.
    if data is None:
        return ""
    return f"\n{linear_modes.modes_report(data)}\n  {folder / 'modes.h5'}"


VERB = PlainVerb(
    name="bands",
    text="pass bands, gaps and group velocities of a cell",
    example="bands runs/examples/three-mass.toml --json",
    arguments=(CASE, MODES, NEAR, SET, OUT, JSON),
    function=bands,
    is_answer=True,
)
