"""What the verbs print: tables of a case, its bands, a finished run, and the installation."""

from __future__ import annotations

import importlib
import json
import shutil
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case
from vipetsc.io.folder import provenance
from vipetsc.io.store import GATHER_LIMIT
from vipetsc.lattice import UnitCell, max_group_velocity, pass_bands
from vipetsc.lattice.bloch import gaps, waves_at

if TYPE_CHECKING:
    from vipetsc.dynamics import Result
    from vipetsc.studies.sweep import SweepResult

# Time of one step of the default method per mass and per step, measured on one 2020s core.
_STEP_SECONDS, _STEP_SECONDS_PER_MASS = 2e-5, 7e-8


def _table(rows: Iterable[tuple[str, str]]) -> str:
    rows = list(rows)
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name:<{width}}  {value}" for name, value in rows)


def bands_table(cell: UnitCell, as_text: bool = False) -> Any:
    """Bands of a cell with edges (rad/s) and largest group velocity (cells/s), and gaps; a dict or a text."""
    bands = pass_bands(cell)
    rows = []
    for band in bands:
        kappa, frequency, speed = max_group_velocity(cell, band.number)
        rows.append(
            {
                "band": band.number,
                "low": band.low,
                "high": band.high,
                "max_group_velocity": {"wavenumber": kappa, "frequency": frequency, "group_velocity": speed},
            }
        )
    table = {"units": {"frequency": "rad/s", "group_velocity": "cells/s", "wavenumber": "rad/cell"}, "bands": rows}
    table["gaps"] = [{"low": low, "high": high} for low, high in gaps(bands)]
    if not as_text:
        return table
    lines = ["band       low      high  rad/s    fastest: kappa/pi   rad/s   cells/s"]
    for row in rows:
        best = row["max_group_velocity"]
        lines.append(
            f"{row['band']:4d} {row['low']:9.2f} {row['high']:9.2f}           "
            f"{best['wavenumber'] / np.pi:16.4f} {best['frequency']:8.2f} {best['group_velocity']:8.2f}"
        )
    lines += [f" gap {low:9.2f} {high:9.2f}" for low, high in gaps(bands)]
    return "\n".join(lines)


def sweep_table(result: SweepResult) -> str:
    """How a sweep ended: counts, time, what failed."""
    complete, scaled, failed = (result.count(status) for status in range(3))
    rows = [
        (
            "members",
            f"{len(result.outcomes)}: {complete} simulated, {scaled} scaled from a linear run, {failed} failed",
        ),
        ("made now", f"{result.made} in {result.seconds:.1f} s"),
        ("ranks busy", ", ".join(f"{100 * share:.0f} %" for share in result.busy)),
    ]
    missing = sum(o is None for o in result.outcomes)
    if missing:
        rows.append(("missing", f"{missing}; stopped on request, the same command goes on"))
    else:
        rows.append(("leaves", str(result.folder / "ensemble.h5")))
    with open(result.folder / "index.json", encoding="utf-8") as file:
        places = [(row["place"], row["reason"]) for row in json.load(file)["members"] if row["status"] == "failed"]
    rows += [("failed", f"member {place}: {reason}") for place, reason in places[:10]]
    return _table(rows)


def validate_table(case: Case, ranks: int) -> str:
    """What follows from a case: bands, drive, times, samples, file size, cost."""
    model = case.model()
    cell, chain = model.chain.cell, model.chain
    bands = pass_bands(cell)
    waves = waves_at(cell, model.drive.frequency)
    masses = chain.cells * cell.dofs
    kept = len(range(*_window(case), case.output.every)) * cell.dofs * len(case.output.fields)
    size = 8 * kept * -(-model.samples // case.output.stride)
    steps = model.samples * max(np.ceil(model.sample_interval * bands[-1].high / 0.37), 1) * 1.3
    cost = steps * (_STEP_SECONDS + _STEP_SECONDS_PER_MASS * masses / ranks)
    writer = case.output.writer
    if writer == "auto":
        writer = "parallel" if size > GATHER_LIMIT and ranks > 1 else "gather"
    edges = [f"{b.low:.2f}-{b.high:.2f}" for b in bands]
    rows = [
        ("case", case.name),
        ("lattice", f"{chain.cells} cells, {masses} masses, {chain.ends} ends, reading {case.lattice.reading}"),
        ("pass bands", ", ".join(edges) + " rad/s"),
        ("gaps", ", ".join(f"{a:.2f}-{b:.2f}" for a, b in gaps(bands)) + " rad/s" if gaps(bands) else "none"),
        ("contact", f"{case.contacts.law}, {model.contact.stiffness:.6g} N/m^{model.contact.law.exponent:g}, "
                    f"restitution {model.contact.restitution:g}"),
        ("sites", _few([c + 1 for c in chain.sites])),
        ("clearance", _few([f"{1e3 * c:.4g}" for c in chain.clearances]) + " mm" if chain.sites else "none"),
        ("drive", f"{model.drive.amplitude:g} N, {model.drive.cycles} cycles, Om = {model.drive.frequency:.4f} rad/s"),
        ("waves at Om", "; ".join(f"band {b}, kappa = {k / np.pi:.4f} pi, v_g = {v:.2f} cells/s" for b, k, v in waves)
                        or "none: in a gap"),
        ("burst, end", f"{model.drive.duration:.6g} s, {model.end:.6g} s"),
        ("samples", f"{model.samples}, every {model.sample_interval:g} s"),
        ("tolerances", f"rtol {model.rtol:g}, atol {model.atol[0]:.3g} m and {model.atol[1]:.3g} m/s"),
        ("file size", f"{size / 2**20:.4g} MiB ({writer})"),
        ("cost", f"about {steps:.3g} steps of engine ts, {_duration(cost)} on {ranks} rank{'s' * (ranks > 1)} before"
                 " contacts"),
    ]  # fmt: skip
    return _table(rows)


def _window(case: Case) -> tuple[int, int]:
    first, last = case.output.window or (1, case.lattice.cells)
    return first - 1, last


def _few(items: list) -> str:
    shown = ", ".join(str(i) for i in items[:8])
    return "none" if not items else shown + (f", ... ({len(items)})" if len(items) > 8 else "")


def _duration(seconds: float) -> str:
    return f"{seconds:.2g} s" if seconds < 120 else f"{seconds / 60:.3g} min"


def run_table(result: Result) -> str:
    """How a run ended and its numbers."""
    s = result.statistics
    how = f"{s['method']}, {s['right_hand_side']}"
    steps = f"{s['steps']} accepted, {s['rejected']} rejected ({how})"
    if s["engine"] == "propagator":
        steps = (
            f"{s['steps']} linear ({s['method']}, {s['bandwidth']} cells each way, exact to {s['truncation']:.1g}), "
        )
        steps += f"{s['substeps']} with forces"
    rows = [
        ("impacts", f"{s['episodes']} episodes, {s['landings']} landings"),
        ("steps", steps),
        ("time", f"{s['wall_seconds']:.2f} s wall, {s['cpu_seconds']:.2f} s CPU of all ranks"),
        ("folder", str(result.folder)),
    ]
    if s.get("work"):
        share = s["dissipated"] / s["work"]
        rows.insert(0, ("energy", f"work {s['work']:.6g} J, dissipated {100 * share:.4g} %, "
                                  f"ledger closes to {s['ledger_error']:.2g} of the work"))  # fmt: skip
    if "engine_note" in s:
        rows.append(("engine", f"{s['engine']}: {s['engine_note']}"))
    acted = {n: s[n] for n in ("grazes", "floored", "clipped", "pulled") if s[n]}
    if acted:
        rows.insert(2, ("limits", ", ".join(f"{n} {count}" for n, count in acted.items())))
    return f"{result.sentence}\n{_table(rows)}"


def doctor_table(comm: MPI.Comm) -> tuple[str, bool]:
    """Versions and checks of this installation, and whether all is well; all ranks must call it."""
    import h5py

    rows = [(name.replace("_version", ""), str(value)) for name, value in provenance(comm).items()]
    healthy = True

    def check(fine: bool, name: str, value: str, remedy: str) -> None:
        nonlocal healthy
        healthy &= fine
        rows.append((name, value if fine else f"MISSING: {remedy}"))

    from petsc4py import PETSc

    scalar = np.dtype(PETSc.ScalarType)
    check(scalar == np.float64, "petsc scalars", str(scalar), "a real double PETSc (Debian: petsc-dev)")
    remedy = "the MPI build of h5py (Debian: python3-h5py-mpi; conda-forge: h5py=*=mpi_openmpi*)"
    check(
        comm.size == 1 or h5py.get_config().mpi,
        "parallel HDF5",
        "yes" if comm.size > 1 else "under mpirun",
        remedy,
    )
    check(shutil.which("mpirun") is not None, "mpirun", str(shutil.which("mpirun")), "apt install openmpi-bin")
    for module in ("scipy", "matplotlib", "jinja2", "numba", "pydantic", "tqdm", "tomli_w"):
        try:
            version = getattr(importlib.import_module(module), "__version__", "yes")
            check(True, module, version, "")
        except ImportError:
            check(False, module, "", f"pip install --constraint scripts/constraints.txt {module.replace('_', '-')}")
    try:
        from vipetsc.dynamics.ts import native

        native.compile_callback()
        check(True, "native right-hand side", "yes", "")
    except (AttributeError, OSError) as error:
        rows.append(("native right-hand side", f"no, the Python one is used ({error})"))
    hosts = comm.allgather(MPI.Get_processor_name())
    rows.append(("hosts", ", ".join(f"{h} x{hosts.count(h)}" for h in sorted(set(hosts)))))
    verdict = "all is well" if healthy else "something is missing, see above"
    return f"{_table(rows)}\n{verdict}", healthy
