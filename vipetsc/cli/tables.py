"""What the verbs print: tables of a case, its bands, and how runs, sweeps and branches ended."""

import json
import logging
import math
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, CaseError, CaseFile, DesignCase, LawCase, NnmCase, Problem, Sweep
from vipetsc.case.contacts import describe_stops
from vipetsc.case.disorder import DisorderTable, values_of
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.sweep import MOST_TRIED
from vipetsc.cli.lattice import ends_text, initial_text, loss_text
from vipetsc.io.lock import locked
from vipetsc.lattice import UnitCell, gaps, max_group_velocity, pass_bands, waves_at

if TYPE_CHECKING:
    from vipetsc.dynamics import Result
    from vipetsc.modes.branches.branch import Branch
    from vipetsc.modes.point import Point
    from vipetsc.studies.sweep import SweepResult

logger = logging.getLogger(__name__)


def table(rows: Sequence[tuple[str, str]]) -> str:
    """Names and values in two columns; a row without a value is left out."""
    width = max(len(name) for name, value in rows if value)
    return "\n".join(f"  {name:<{width}}  {value}" for name, value in rows if value)


def bands_table(cell: UnitCell) -> dict[str, Any]:
    """Bands of a cell with edges and largest group velocity, and gaps."""
    rows = []
    for band in pass_bands(cell):
        kappa, frequency, speed = max_group_velocity(cell, band.number)
        fastest = {"wavenumber": kappa, "frequency": frequency, "group_velocity": speed}
        rows.append({"band": band.number, "low": band.low, "high": band.high, "max_group_velocity": fastest})
    return {
        "units": {"frequency": "rad/s", "group_velocity": "cells/s", "wavenumber": "rad/cell"},
        "bands": rows,
        "gaps": [{"low": low, "high": high} for low, high in gaps(pass_bands(cell))],
    }


def bands_report(bands: dict[str, Any]) -> str:
    """``bands_table`` as text."""
    lines = ["band       low      high  rad/s    fastest: kappa/pi   rad/s   cells/s"]
    for row in bands["bands"]:
        best = row["max_group_velocity"]
        lines.append(
            f"{row['band']:4d} {row['low']:9.2f} {row['high']:9.2f}           "
            f"{best['wavenumber'] / np.pi:16.4f} {best['frequency']:8.2f} {best['group_velocity']:8.2f}"
        )
    return "\n".join(lines + [f" gap {gap['low']:9.2f} {gap['high']:9.2f}" for gap in bands["gaps"]])


def modes_told(case: Case, count: int | None, near: float | None, folder: Path, comm: MPI.Comm) -> str:
    """The linear modes of ``bands --modes`` on rank 0, which writes them; empty if none are asked for."""
    if count is None and near is None:
        return ""
    if count is None:
        raise CaseError([Problem("--near", near, "says near which frequency --modes are; give both")])
    from vipetsc.studies.linear_modes import find_modes, modes_report

    with locked(comm, folder):
        data = find_modes(case, count, near or 0.0, folder, comm)
    return "" if data is None else f"\n{modes_report(data)}\n  {folder / 'modes.h5'}"


def sweep_table(result: "SweepResult") -> str:
    """How a sweep ended: counts, time, what failed."""
    complete, scaled, failed, missing = (result.count(status) for status in range(4))
    counts = f"{complete} simulated, {scaled} scaled from a linear run, {failed} failed"
    rows = [
        ("members", f"{result.status.size}: {counts}"),
        ("made now", f"{result.made} in {result.seconds:.1f} s"),
        ("ranks busy", ", ".join(f"{100 * share:.0f} %" for share in result.busy)),
    ]
    left = ("missing", f"{missing}; stopped on request, the same command goes on")
    rows.append(left if missing else ("leaves", str(result.folder / "ensemble.h5")))
    failures = json.loads((result.folder / "index.json").read_text(encoding="utf-8"))["failed"]
    rows += [("failed", f"member {row['place']}: {row['reason']}") for row in failures[:10]]
    return table(rows)


def case_rows(case: CaseFile, ranks: int) -> list[tuple[str, str]]:
    """What follows from the case of a verb, as rows of a table."""
    if isinstance(case, Sweep):
        tried, counts = case.members(MOST_TRIED), " x ".join(map(str, case.shape))
        impossible = sum(member.case is None for member in tried)
        of = "them" if len(tried) == case.count else len(tried)
        return [("sweep", f"{case.count} members ({counts}), {impossible} of {of} impossible")]
    if isinstance(case, DesignCase):
        search = case.design
        cells = f"{len(search.lam.values())} lambda x {len(search.eta.values())} eta"
        return [("design", f"{cells}, {search.wavenumbers} wavenumbers, {' and '.join(search.readings)}")]
    if isinstance(case, LawCase):
        site = case.one_site()
        where = f"a clearance of {site.clearance:.5g} m {site.distance} cells from the drive"
        return [("law", f"z to {case.law.largest:g}, {where}; ring of {site.cells} cells, {site.samples} samples")]
    if isinstance(case, OptimiseCase):
        options, searched = case.options, [variable.name for variable in case.variables()]
        told = [("objective", objective.describe()) for objective in options.objective]
        return [("optimise", f"{options.budget} designs of {_first_few(searched)}"), *told]
    if isinstance(case, NnmCase):
        contact, (low, high) = case.contact(), case.nnm.energy
        return [
            ("nnm", f"{case.nnm.system} system, modes {_first_few(case.nnm.modes)}, {low:g} to {high:g} J"),
            ("nnm contact", f"{contact.law}, {contact.stiffness:.6g} N/m^{contact.onset_exponent:g}"),
        ]
    assert isinstance(case, Case)
    return run_case_rows(case, ranks)


def run_case_rows(case: Case, ranks: int) -> list[tuple[str, str]]:
    """What follows from a case of a run: bands, drive, times, samples, file size, cost."""
    from vipetsc.dynamics.cost import estimate
    from vipetsc.dynamics.memory import check_indices, memory_available, memory_needed
    from vipetsc.dynamics.recorder import recorded_cells, written_together

    model = case.model()
    check_indices(model)
    cell, chain = model.chain.cell, model.chain
    bands, waves = pass_bands(cell), waves_at(cell, model.drive.frequency)
    columns = len(recorded_cells(case.output, chain.cells)) * cell.dofs * len(case.output.fields)
    size = 8 * (columns * -(-model.samples // case.output.stride) + len(chain.sites) * model.samples)
    cost = estimate(case, ranks)
    hits = (
        f", {duration(cost.contacts)} of it for about {float(f'{cost.episodes:.1g}'):g} contacts"
        if cost.episodes
        else ""
    )
    writer = "parallel" if written_together(model, case.output, ranks) else "gather"
    needed, left = sum(memory_needed(model, case.output, cost.engine, ranks).values()), memory_available() / ranks
    return [
        ("case", case.name),
        ("lattice", f"{chain.cells} cells, {chain.cells * cell.dofs} masses, {ends_text(case)}"
                    + (f", reading {case.lattice.reading}" if case.lattice.preset else "")),
        ("pass bands", ", ".join(f"{b.low:.2f}-{b.high:.2f}" for b in bands) + " rad/s"),
        ("gaps", ", ".join(f"{a:.2f}-{b:.2f}" for a, b in gaps(bands)) + " rad/s" if gaps(bands) else "none"),
        ("loss", loss_text(case)),
        ("contact", "; ".join(dict.fromkeys(map(str, model.laws[:8] or (model.contact,))))),
        ("sites", _first_few([c + 1 for c in chain.sites])),
        ("clearance", _first_few(describe_stops(model.gaps, chain.clearances)) + " mm" if chain.sites else "none"),
        ("begins with", initial_text(case)),
        *(("drive", drive.describe()) for _, drive in case.drive.every),
        ("waves at Om", "; ".join(f"band {b}, kappa = {k / np.pi:.4f} pi, v_g = {v:.2f} cells/s" for b, k, v in waves)
                        or "none: in a gap"),
        ("burst, end", f"{max(drive.waveform.duration for drive in model.drives):.6g} s, {model.end:.6g} s"),
        ("samples", f"{model.samples}, every {model.sample_interval:g} s"),
        ("tolerances", f"rtol {model.rtol:g}, atol {model.atol[0]:.3g} m and {model.atol[1]:.3g} m/s"),
        ("engine", cost.engine + (f": {cost.note}" if cost.note else "")),
        ("disk", f"{size / 2**20:.4g} MiB ({writer}), twice that until the run has ended; "
                 f"{shutil.disk_usage('.').free / 2**30:.4g} GiB are free here"),
        ("memory", f"{needed / 1e9:.3g} GB on a rank" + f", and here are {left / 1e9:.3g} GB" * (needed > left)),
        ("time", f"about {duration(cost.seconds)} on {ranks} rank{'s' * (ranks > 1)}{hits}"),
        ("faster", cost.faster),
    ]  # fmt: skip


def duration(seconds: float) -> str:
    """Seconds, or minutes, in two digits."""
    return f"{seconds:.2g} s" if seconds < 120 else f"{seconds / 60:.3g} min"


def disorder_rows(disorder: DisorderTable, nominal: Case, drawn: Case) -> list[tuple[str, str]]:
    """What scatters, how, and the first values drawn: ``drawn`` beside the case without scatter, ``nominal``."""
    before, after = (values_of(case.lattice, case.contacts) for case in (nominal, drawn))
    rows = []
    for name, deviation in disorder.quantities().items():
        new = after[name] if name == "sites" else np.divide(after[name], before[name])
        beside = "cells " if name == "sites" else "times "
        rows.append(
            (
                f"disorder of {name}",
                f"{deviation}; seed {disorder.seed}: {beside}{_first_few([f'{x:.5g}' for x in new])}",
            )
        )
    return rows


def _first_few(items: Sequence[object]) -> str:
    shown = ", ".join(map(str, items[:8]))
    return "none" if not items else shown + (f", ... ({len(items)})" if len(items) > 8 else "")


def run_table(result: "Result", faster: str = "") -> str:
    """How a run ended and its numbers; ``faster``: what would have been."""
    s = result.statistics
    if s["engine"] == "propagator":
        steps = f"{s['steps']} linear ({s['method']}, {s['bandwidth']} cells each way, exact to {s['truncation']:.1g})"
        steps += f", {s['substeps']} with forces"
    else:
        steps = f"{s['steps']} accepted, {s['rejected']} rejected ({s['method']})"
    energy = ""
    if s.get("work"):
        share = f"dissipated {100 * s['dissipated'] / s['work']:.4g} %"
        energy, damped = f"work {s['work']:.6g} J, {share}", s.get("dissipated_by_damping", 0.0)
        energy += f" in contacts and {100 * damped / s['work']:.4g} % in dashpots" if damped else ""
        energy += f", ledger closes to {s['ledger_error']:.2g} of the work" if s["ledger_error"] is not None else ""
    rebounds = [*dict.fromkeys(np.ravel(s.get("effective_restitution", [])).tolist())]
    rows = [
        ("energy", energy),
        ("impacts", f"{s['episodes']} episodes, {s['landings']} landings"),
        ("restitution", f"{_first_few([f'{e:.3f}' for e in rebounds])} (effective)" if rebounds else ""),
        ("limits", ", ".join(f"{name} {s[name]}" for name in ("grazes", "floored", "clipped", "pulled") if s[name])),
        ("steps", steps),
        ("time", f"{s['wall_seconds']:.2f} s wall, {s['cpu_seconds']:.2f} s CPU of all ranks"),
        ("folder", str(result.folder)),
        ("engine", f"{s['engine']}: {s['engine_note']}" if "engine_note" in s else ""),
        ("faster", faster),
    ]
    return f"{result.sentence}\n{table(rows)}"


def branch_log() -> Callable[["Branch", "Point"], None]:
    """A live table of growing branches: a line a point, no more than two a second."""
    title = "branch           point      T (s)        E (J)  Newton  contacts  max multiplier\n"
    last = -math.inf

    def show(branch: "Branch", point: "Point") -> None:
        nonlocal title, last
        now = time.monotonic()
        if now - last < 0.5:
            return
        logger.info(
            f"{title}{branch.name:<14} {point.index:7d} {point.period:10.4e} {point.energy:12.6e} {point.newton:7d}"
            f" {point.episodes:9d} {point.multiplier:15.6g}"
        )
        title, last = "", now

    return show


def branch_table(branch: "Branch") -> str:
    """How a branch went: length, range, special points, power laws."""
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
    if tongues := branch.tongues():
        lines.append(f"  {len(tongues)} tongues of internal resonances: {', '.join(f'{k}:1' for k in tongues)}")
    for region, law in branch.fits().items():
        lines.append(
            f"  region {region}: df/dE ~ E^{law['exponent']:.4f}, adjusted R^2 {law['adjusted_r2']:.5f}"
            f" ({law['points']} points)"
        )
    return "\n".join(lines)


def prediction_table(data: xr.Dataset) -> str:
    """Predicted and simulated shares at every amplitude, and how far apart they are."""
    kinds = [kind for kind in ("predicted", "simulated") if f"{kind}/other" in data]
    names = "upper", "other", "dissipated"
    lines = ["   amplitude (N)  " + "  ".join(f"{kind} {name}" for name in names for kind in kinds)]
    for row, amplitude in enumerate(data["amplitude"].values):
        shares = (f"{float(data[f'{k}/{n}'][row]):{len(k) + len(n) + 1}.4f}" for n in names for k in kinds)
        lines.append(f"{amplitude:16.5g}  " + "  ".join(shares))
    told = {
        "onset_amplitude": "first contact (N)",
        "rms_upper": "rms of the upper bands (decades)",
        "rms_other": "rms of all bands but the driven one (decades)",
        "worst_dissipated": "largest difference of what is dissipated",
        "cpu_seconds": "CPU time without the simulations (s)",
    }
    return "\n".join(lines + [f"{text}: {data.attrs[key]:.4g}" for key, text in told.items() if key in data.attrs])
