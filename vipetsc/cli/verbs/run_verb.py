"""The verb ``run``: one simulation with analysis and pictures, or a member of a sweep with all its fields."""

import argparse
import json
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vipetsc.case import Case, CaseError, Model, Problem, Sweep
from vipetsc.case.points import PointTable
from vipetsc.case.wave_at_sites import sends_one_wave, wave_over_clearance
from vipetsc.case.waveforms import DEFAULT
from vipetsc.cli.arguments import CASE, STUDY_ARGUMENTS, argument
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.messages import duration, first_few, logger, table
from vipetsc.cli.verb import Outcome, Rows, StudyVerb, Work
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import RUN
from vipetsc.lattice import waves_at
from vipetsc.parallel import on_root
from vipetsc.wording import MOST_SHOWN, counted

if TYPE_CHECKING:
    from vipetsc.dynamics import Result

# What a run counts where a contact reaches a limit of the law or of the method, as a sentence that begins "n contacts".
LIMITS = {
    "floored": "slower than contacts.approach_floor",
    "clipped": "cut off where damping would have pulled",
    "pulled": "pulled by damping for a moment",
    "missed": "with a change inside a step",
    "forced": "in a step whose error exceeds rtol",
}

MEMBER = argument(
    "--member",
    metavar="ID",
    help="repeat a member of a sweep with all its fields: its name or number; CASE is the sweep's file or folder",
)

EXTEND = argument(
    "--extend", action="store_true", help="go on from the end of the run in the output folder to a later time.end"
)


def load(options: argparse.Namespace) -> Case:
    """Return the case of the file, or of one member if ``--member`` names it and CASE is a sweep; raises CaseError."""
    if options.member is None:
        return Case.load(options.case, options.set)

    plan = _sweep_of(options)
    number = plan.number(options.member)
    if plan.options.follow == "none":
        case = plan.case(number, options.set)
    else:
        folder = Path(options.case)
        if not folder.is_dir():
            remedy = "begins with the end of another member; give the folder of the finished sweep, not its file"
            raise CaseError([Problem("--member", options.member, remedy)])
        case = plan.case_in(folder, number, options.set)
    return case.varied(name=f"{plan.name}-{plan.ids()[number]}")


def _sweep_of(options: argparse.Namespace) -> Sweep:
    """Return the sweep whose file or folder is given as CASE; raises CaseError."""
    # Without CASE the path is a text that names no file: the message about that file then says what is missing.
    path = Path(options.case or "the case of a sweep")
    if path.is_dir():
        path = path / "case.toml"
    return Sweep.load(path)


def simulate_and_measure(case: Case, work: Work) -> Outcome:
    """Simulate the case, and measure its fields and the motion of its named points, as far as they are stored."""
    from vipetsc.dynamics import simulate
    from vipetsc.dynamics.plan import estimate
    from vipetsc.io.export import has_xdmf, write_xdmf

    result = simulate(case, work.folder, work.comm, extend=work.options.extend, **work.keywords)
    work.warn(result.warnings)
    plan = result.plan
    assert plan is not None
    faster = on_root(work.comm, lambda: estimate(plan, work.comm.size).faster)
    measured_drives = [
        drive.describe() for _, drive in case.drive.every if drive.amplitude and drive.samples is not None
    ]
    work.report(run_table(result, faster, measured_drives))
    if work.comm.rank == 0:
        logger.debug("statistics %s", json.dumps(result.statistics))
    # After a request to stop: the run is saved, and the next command measures it.
    work.stop.check(work.comm)

    # Measures need a second sample: a run that fails in its first has none.
    has_two_samples = result.statistics["samples"] > 1
    has_fields = bool(case.output.fields) and has_two_samples
    has_points = bool(case.output.points) and has_two_samples
    if has_fields or has_points:
        measure_unless_measured(case, work)
        on_root(work.comm, lambda: has_xdmf(work.folder) or write_xdmf(work.folder))
        measured, unsettled = on_root(work.comm, lambda: measures_of_points(case, work.folder))
        work.warn(unsettled)
        if measured:
            work.report(measured)
    return Outcome(complete=result.complete, drawable=has_fields)


def measure_unless_measured(case: Case, work: Work) -> None:
    """Measure the run of ``case`` in the folder of ``work`` if its measures are missing or older; collective."""
    from vipetsc.studies.analysis_options import is_measured
    from vipetsc.studies.linear_run import linear_arrival
    from vipetsc.studies.reanalysis import measure_run

    if on_root(work.comm, lambda: is_measured(work.folder)):
        return
    if not work.options.member:
        measure_run(work.folder, comm=work.comm)
        return

    # As in its sweep, the member is measured from the arrival of the wave of its linear run, which the folder of the
    # sweep has on record.
    sweep = Path(work.options.case)
    if sweep.is_file():
        sweep = sweep.parent
    measure_run(work.folder, sweep, comm=work.comm, find_arrival=lambda: linear_arrival(case, work.comm, work.stop))


def run_rows(case: Case, ranks: int) -> Rows:
    """Return the rows of ``validate`` on a run: lattice, drive, times, samples, files, memory and time on ``ranks``."""
    from vipetsc.dynamics.memory import check_size, memory_available, memory_needed
    from vipetsc.dynamics.plan import RunPlan, estimate
    from vipetsc.dynamics.recorded_sizes import recorded_cells

    plan = RunPlan.of(case)
    model = plan.model
    check_size(model)
    chain = model.chain
    cost = estimate(plan, ranks)

    begins_with = ""
    if case.initial:
        begins_with = case.initial.describe()

    # The file holds doubles: fields at every stride-th sample; at all samples the losses of each site, perhaps its
    # force, and three quantities of each point. The rest is small.
    columns = len(recorded_cells(case.output, chain.cells)) * chain.cell.dofs * len(case.output.fields)
    every_sample = len(chain.sites) * (1 + bool(case.output.forces)) + 3 * len(case.output.points or [])
    size = 8 * (columns * -(-model.samples // case.output.stride) + every_sample * model.samples)
    free = shutil.disk_usage(".").free

    # Ranks on one machine divide its memory among them.
    needed = sum(memory_needed(model, case.output, plan.engine.name, ranks).values())
    available = memory_available() / ranks
    memory = f"{needed / 1e9:.3g} GB per rank"
    if needed > available:
        memory += f", but only {available / 1e9:.3g} GB are available"

    engine = plan.engine.name
    if plan.engine.refused:
        engine += f": {plan.engine.refused}"

    return [
        *lattice_rows(case),
        ("begins with", begins_with),
        *_drive_rows(case),
        ("wave/clearance", _closing(model)),
        ("contacts", _contacts_of_burst(model)),
        ("samples", f"{model.samples}, every {model.sample_interval:g} s"),
        ("points", ", ".join(map(partial(point_text, case), case.output.points or []))),
        ("tolerances", f"rtol {model.rtol:g}, atol {model.atol[0]:.3g} m and {model.atol[1]:.3g} m/s"),
        ("engine", engine),
        ("disk", f"{size / 2**20:.4g} MiB, twice that during the run; {free / 2**30:.4g} GiB free here"),
        ("memory", memory),
        ("time", f"about {duration(cost.seconds)} on {counted(ranks, 'rank')}"),
        ("faster", cost.faster),
    ]


def _closing(model: Model) -> str:
    """Return the linear wave over the clearance of each site, the nearer stop of two; "" without a wave or a site."""
    if not (model.chain.sites and sends_one_wave(model)):
        return ""
    ratios = wave_over_clearance(model).max(axis=1)
    return first_few([f"{ratio:.3g}" if ratio < np.inf else "touching" for ratio in ratios])


def _contacts_of_burst(model: Model) -> str:
    """Return about how many contacts a burst causes; "" without a burst of one wave, a site, or a contact."""
    from vipetsc.dynamics.cost import MOVING_ON, expected_episodes

    if not (model.chain.sites and sends_one_wave(model)) or model.drive.repeats:
        return ""
    count = MOVING_ON * expected_episodes(model)
    if not 0 < count < np.inf:
        return ""
    return f"about {float(f'{count:.2g}'):g}, within a factor of two; more where waves return to the sites"


def _drive_rows(case: Case) -> Rows:
    """Return rows on the drives, the waves at their frequency, and the times at which the drives and the run end."""
    model = case.model()
    rows: Rows = []
    # A beam has a drive at each of its places.
    for _, drive in case.drive.every[:MOST_SHOWN]:
        text = "none"
        if drive.amplitude:
            text = drive.describe()
        rows.append(("drive", text))
    if len(case.drive.every) > MOST_SHOWN:
        rows.append(("drive", f"and {len(case.drive.every) - MOST_SHOWN} more"))

    # Where nothing is driven, the waves are those of the motion that the lattice begins with.
    omega = case.wave_frequency
    if omega and model.chain.cell.joins_cells:
        waves = [
            f"band {band}, kappa = {kappa / np.pi:.4f} pi, v_g = {speed:.2f} cells/s"
            for band, kappa, speed in waves_at(model.chain.cell, omega)
        ]
        # A wide cell has as many bands as masses.
        if len(waves) > MOST_SHOWN:
            waves = [*waves[:MOST_SHOWN], f"and {len(waves) - MOST_SHOWN} more"]
        rows.append(("waves at Om", "; ".join(waves) or "none: the frequency is in a gap"))

    run_end = f"{model.end:.6g} s"
    if not model.is_driven:
        return [*rows, ("end", run_end)]
    noun = "drive"
    if all(drive.kind == DEFAULT for _, drive in case.drive.every):
        noun = "burst"
    drive_end = "no end"
    last = max(drive.waveform.duration for drive in model.drives)
    if last < np.inf:
        drive_end = f"{last:.6g} s"
    return [*rows, (f"{noun}, end", f"{drive_end}, {run_end}")]


def run_table(result: "Result", faster: str = "", drives: Sequence[str] = ()) -> str:
    """Return the ending and the statistics of a run as text, with descriptions of its measured ``drives``.

    ``faster`` names a faster alternative, if there is one.
    """
    numbers = result.statistics
    if numbers["engine"] == "propagator":
        method = f"{numbers['method']}, {numbers['bandwidth']} cells to each side, exact to {numbers['truncation']:.1g}"
        steps = f"{numbers['steps']} linear ({method}), {numbers['substeps']} with forces"
    else:
        steps = f"{numbers['steps']} accepted, {numbers['rejected']} rejected ({numbers['method']})"

    energy = ""
    # Losses are relative to the work, of which there is none in a lattice that only begins with a motion.
    if work := numbers.get("work"):
        energy = f"work {work:.6g} J, dissipated {100 * numbers['dissipated'] / work:.4g} %"
        if damped := numbers.get("dissipated_by_damping", 0.0):
            energy += f" in contacts and {100 * damped / work:.4g} % in dashpots"
        if (quadrature := numbers.get("damping_quadrature")) is None:
            energy += f", ledger closes to {numbers['ledger_error']:.2g} of the work"
        else:
            tolerance = numbers["damping_quadrature_error"] / work
            energy += f" (by the balance; the samples' power gives {100 * quadrature / work:.4g} %"
            energy += f" with an error of about {100 * tolerance:.2g} %)"

    restitution = ""
    rebounds = [*dict.fromkeys(np.ravel(numbers.get("effective_restitution", [])).tolist())]
    if rebounds:
        restitution = f"{first_few([f'{e:.3f}' for e in rebounds])} (effective)"
    exponent = ""
    if (largest := numbers.get("lyapunov")) is not None:
        exponent = f"{largest:.4g} +- {numbers['lyapunov_error']:.2g} 1/s, the largest exponent"
    limits = [f"{counted(numbers[name], 'contact')} {text}" for name, text in LIMITS.items() if numbers.get(name)]
    engine = ""
    if note := numbers.get("engine_note"):
        engine = f"{numbers['engine']}: {note}"
    time = f"{numbers['wall_seconds']:.2f} s wall, {numbers['cpu_seconds']:.2f} s CPU of all ranks"

    rows = [
        *[("drive", text) for text in drives],
        ("energy", energy),
        ("impacts", f"{numbers['episodes']} episodes, {numbers['landings']} landings"),
        ("restitution", restitution),
        ("lyapunov", exponent),
        ("limits", ", ".join(limits)),
        ("steps", steps),
        ("time", time),
        ("folder", str(result.folder)),
        ("engine", engine),
        ("faster", faster),
    ]
    return f"{result.sentence}\n{table(rows)}"


def point_text(case: Case, point: PointTable) -> str:
    """Return the name of a named ``point`` and where it is."""
    strip = case.lattice.section_of_strip
    if strip:
        return f"{point.name} {strip.place(point.cell, point.mass)}"
    return f"{point.name} (cell {point.cell}, mass {point.mass})"


def measures_of_points(case: Case, folder: Path) -> tuple[str, list[str]]:
    """Return a table of the measures of the run's named points, and sentences about steady amplitudes that are none.

    The table is empty if the case names no points.
    """
    from vipetsc.io.netcdf import open_netcdf
    from vipetsc.spectra.measures import MEASURES, measures_of

    points = [point.name for point in case.output.points or []]
    if not points:
        return "", []
    rows = []
    with open_netcdf(folder / "analysis.h5", "analysis") as analysis:
        for name in measures_of(points, case.output.transmission or []):
            # Measures of the whole run, and those that were not taken, have no row.
            if name in MEASURES or name not in analysis:
                continue
            item = analysis[name]
            if np.isnan(item.values).all():
                rows.append((name, "no value"))
                continue

            text = ", ".join(f"{value:.5g}" for value in np.atleast_1d(item.values))
            if item.attrs["units"] != "1":
                text += f" {item.attrs['units']}"
            if "parts" in item.attrs:
                text += f" ({', '.join(np.atleast_1d(item.attrs['parts']))})"
            rows.append((name, text))
        unsettled = json.loads(analysis.attrs["unsettled"])
    return table(rows), unsettled


def measure_where_missing(folders: Sequence[Path]) -> None:
    """Check that each of ``folders`` holds a finished run, and measure the runs whose measures are missing.

    Measures that are older than the run count as missing. Raises FolderError if there is no run, or none that can be
    read.
    """
    for folder in folders:
        _measure_where_missing(folder)


def _measure_where_missing(folder: Path) -> None:
    """Measure the run in ``folder`` if its measures are missing; raises as ``measure_where_missing``."""
    from vipetsc.studies.analysis_options import is_measured

    run = folder / "run.h5"
    if not run.exists():
        raise FolderError(f"{folder}: contains no run.h5; give the folder of a finished run")
    try:
        measured = is_measured(folder)
    except (FolderError, CaseError):
        # The message says which file or key, and why.
        raise
    # OSError: no HDF5 file. ValueError or KeyError: a file of another program.
    except (OSError, ValueError, KeyError) as error:
        raise FolderError(f"{run}: is not a run of vipetsc ({error})") from None
    if not measured:
        from vipetsc.studies.reanalysis import measure_run

        measure_run(folder)


def hold_runs(folders: Sequence[Path]) -> bool:
    """Return whether each of ``folders`` holds a finished run."""
    return all((folder / RUN.file).exists() for folder in folders)


PICTURES = Pictures(RUN, prepare=measure_where_missing, recognise=hold_runs)
VERB = StudyVerb(
    name="run",
    text="simulate a case, analyse it and draw pictures",
    example="run runs/examples/diatomic.toml --set drive.amplitude=0.8 --out runs/soft",
    arguments=(CASE, MEMBER, *STUDY_ARGUMENTS, EXTEND),
    case=Case,
    load=load,
    study=simulate_and_measure,
    table=run_rows,
    results=RUN,
    pictures=PICTURES,
    takes_petsc_options=True,
)
