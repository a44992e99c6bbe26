"""The record of a run from which ``vipetsc.spectra.measures`` computes measures."""

import numpy as np
import xarray as xr

from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.lattice import pass_bands
from vipetsc.spectra import Parts
from vipetsc.spectra.histories import History, SteadyDrive
from vipetsc.spectra.measures import MOTIONS, PERIODS, TOLERANCE, RunRecord


def record_of(run: xr.Dataset, case: Case, options: AnalysisTable) -> RunRecord:
    """Return the record of a ``run`` of ``case``, open or in memory; ``options`` say how its steady state is found."""
    output = case.output
    cell = case.lattice.unit_cell()
    # Cells that contacts alone join have no bands: the whole frequency axis is one part.
    parts = Parts(np.array([0.0, np.inf]), ("above",), ((),))
    if cell.joins_cells:
        parts = Parts.of(pass_bands(cell))

    points: dict[str, History] = {}
    if "points/velocity" in run:
        time = run["time"].values
        motion = {quantity: run[f"points/{quantity}"].values for quantity in MOTIONS}
        for number, point in enumerate(output.points or []):
            columns = {quantity: values[:, number] for quantity, values in motion.items()}
            points[point.name] = History(time=time, **columns)
    return RunRecord(
        run=run,
        points=points,
        # Without the points' motion nothing is transmitted between them.
        pairs=(output.transmission or []) if points else [],
        edges=np.asarray(parts.edges),
        parts=parts.names,
        drive=steady_drive(case),
        periods=options.steady_periods or PERIODS,
        tolerance=options.steady_tolerance or TOLERANCE,
    )


def steady_drive(case: Case) -> SteadyDrive | None:
    """Return the harmonic part of the first drive of ``case``, between its ramps; None without a harmonic drive."""
    drive = case.drive
    if drive.kind != "harmonic" or not drive.amplitude or not drive.frequency:
        return None
    ramp = drive.ramp or 0.0
    stop = np.inf
    if drive.duration is not None:
        # It falls over a ramp as long as the first one.
        stop = drive.duration - ramp
    return SteadyDrive(frequency=drive.frequency, start=ramp, stop=stop)
