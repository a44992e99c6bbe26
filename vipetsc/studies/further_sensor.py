"""One more sensor for an identification: at which mass it would lower the error of each parameter most.

A sensor adds the derivatives of what it measures, over its noise, as rows to the Jacobian. The same runs give the
derivatives at all candidate masses, so that no candidate needs a fit of its own.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vipetsc.case.identify import SensorTable
from vipetsc.identification.growing_windows import GrowingWindows
from vipetsc.identification.misfit import ROWS
from vipetsc.identification.uncertainty import Uncertainty, errors_with_sensor

# Masses at most, evenly over the lattice, at which a sensor is tried.
MOST_CANDIDATES = 400
# Derivatives at these masses that are kept in memory, at most: 40 MB, those of a thousand samples by ten parameters.
MOST_NUMBERS = 5_000_000


def _further_sensor(sensors: Sequence[SensorTable], noise: np.ndarray) -> tuple[str, float]:
    """Return the quantity that one more sensor would measure, and its noise in that quantity's unit.

    They are those of the first of the ``sensors`` that measures motion, and the mean ``noise`` (sensor,) of all that
    measure the same; without any, a velocity with a noise of 1 m/s.
    """
    quantities = [sensor.quantity for sensor in sensors]
    of_motion = [quantity for quantity in quantities if quantity != "force"]
    if not of_motion:
        return "velocity", 1.0
    return of_motion[0], float(np.mean(noise[np.equal(quantities, of_motion[0])]))


def further_sensor_values(windows: GrowingWindows, z: np.ndarray, uncertainty: Uncertainty) -> dict[str, Any]:
    """Return the mass at which one more sensor of the first record with contact would lower each error most.

    ``windows`` is the fit, ``z`` (coordinate,) its solution. The ``uncertainty`` is that of all coordinates: the sensor
    also measures an initial state that is estimated. Returns variables of ``identified.h5`` by name: the cell and the
    mass, both from 1, and the error with the sensor, for each parameter.
    """
    misfit = windows.misfit
    plan = misfit.plan
    tables = plan.options.records
    record = next((number for number, table in enumerate(tables) if table.contact), 0)
    quantity, noise = _further_sensor(tables[record].sensors, misfit.noise[record])

    dofs = plan.base.lattice.unit_cell().dofs
    count = plan.base.lattice.cells * dofs
    candidates = np.arange(0, count, -(-count // MOST_CANDIDATES))
    # Of long records of large lattices every n-th sample, which stands for n of them, is enough.
    times = misfit.records[record].times
    stride = -(-len(times) * len(candidates) * len(z) // MOST_NUMBERS)

    def measured(moved: np.ndarray) -> np.ndarray:
        """Return what sensors at all candidates would measure (sample, mass) at the coordinates ``moved``."""
        response = misfit.respond(moved, record, candidates.tolist(), times[::stride])
        return response.motion[:, :, ROWS[quantity]]

    slopes = np.zeros((len(times[::stride]), len(candidates), len(z)))
    for p in range(len(z)):
        if misfit.acts_on(p, record):
            # Each sample stands for ``stride`` of them, whose information adds: sensitivities grow with its root.
            slopes[:, :, p] = np.sqrt(stride) * misfit.difference(z, p, measured)
    errors = errors_with_sensor(uncertainty, slopes, noise)[:, : misfit.count]
    chosen = errors.argmin(axis=0)
    return {
        "sensor/cell": candidates[chosen] // dofs + 1,
        "sensor/mass": candidates[chosen] % dofs + 1,
        "sensor/relative_error": errors.min(axis=0),
    }
