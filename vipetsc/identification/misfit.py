r"""Residuals of measured records and their Jacobian, over windows from the beginning of each record.

**An initial state** may be estimated with the parameters (``InitialState``). The state of a lattice of n masses has 2n
numbers. With the modes phi_k (mass-normalised) and frequencies W_k in rad/s of the lattice without contacts they are
written as

    u = sqrt(e) sum_k a_k phi_k/W_k,    u' = sqrt(e) sum_k b_k phi_k,

so that e(a_k^2 + b_k^2)/2 is the energy of mode k in J. The coordinates of the fit are the a_k, then the b_k. If they
were independent and normal with variance 1, the derivative of order r of u_i would have the mean square
e sum_k (phi_ki W_k^(r-1))^2. Each sensor thus has an e with which this is the mean square that it measured; the scale e
in J is the largest of them. Coordinates are then numbers of order one wherever in the lattice the energy is.

A few sensors may not determine all coordinates. A weak prior, normal with a standard deviation of ``WIDTH``, keeps the
others finite: no mode has more than some hundred times e, the energy of a mode that was measured.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import scipy

from vipetsc.case import CaseError, Model
from vipetsc.case.drive import first_built
from vipetsc.case.identify import IdentifyCase, Measured, SensorTable
from vipetsc.dynamics.drives import create_drives, drive_forces
from vipetsc.identification.motion import MotionError, RecordedMotion, SampledModel, State

# Standard deviation of the prior of a coordinate, which has to be wide.
WIDTH = 10.0
# Standard deviation while windows grow and data are few: that of modes with the energy that was measured.
NARROW = 1.0
# A mode without stiffness has W = 0, and 1/W is infinite. This fraction of the lowest elastic frequency takes the place
# of W: with the same coordinate the mode's displacement is ten times that of the slowest elastic mode.
SLOW = 0.1
# Frequencies below this fraction of the highest one are those of modes without stiffness. Squared frequencies are
# rounded at 1e-16 of the highest one's square: zero comes out as 1e-8 of the highest frequency.
RIGID = 1e-6


class InitialState(NamedTuple):
    """A state (2n,) that is estimated: ``matrix`` (2n, 2n) times its coordinates.

    Among all coordinates of the fit they have the indices from ``first`` on.
    """

    first: int
    matrix: np.ndarray

    @property
    def stop(self) -> int:
        """The index behind the last coordinate."""
        return self.first + len(self.matrix)

    @property
    def indices(self) -> range:
        """The indices of the coordinates."""
        return range(self.first, self.stop)


def initial_state(model: Model, first: int, sensors: Sequence[tuple[int, int, float]]) -> InitialState:
    """Return the initial state of ``model`` in coordinates that have the indices from ``first`` on.

    A sensor is the mass (0-based), the order of the derivative of its displacement that is measured, and the root mean
    square of what was measured.
    """
    # Modes of the lattice without contacts.
    masses = model.chain.masses()
    stiffness = model.chain.stiffness_matrix().toarray()
    roots = np.sqrt(masses)
    squares, vectors = scipy.linalg.eigh(stiffness / np.outer(roots, roots))
    frequencies = np.sqrt(np.maximum(squares, 0.0))

    # Without any spring the drive sets the scale of the frequencies.
    elastic = frequencies > RIGID * frequencies[-1]
    lowest = model.drive.frequency
    if elastic.any():
        lowest = frequencies[elastic].min()
    frequencies = np.maximum(frequencies, SLOW * lowest)
    shapes = vectors / roots[:, None]

    # sqrt(e), the largest of the sensors'.
    scale = 0.0
    for mass, order, size in sensors:
        deviation = np.sqrt(np.sum((shapes[mass] * frequencies ** (order - 1)) ** 2))
        scale = max(scale, size / deviation)
    return InitialState(first, scale * scipy.linalg.block_diag(shapes / frequencies, shapes))


# Rows of a motion, by the quantity of a sensor.
ROWS = {"displacement": 0, "velocity": 1, "acceleration": 2}
# Residual of a motion that cannot be computed, in units of the noise and, if that is larger, of the size of the data: a
# step that leads there is rejected.
REJECTED = 1e8
REJECTED_SIZE = 1e3
# Derivatives by a coordinate are differences between runs that are 2 h apart; this is h. A fit with a relative error e
# of its derivatives ends e/s standard errors away, with the smallest singular value s of the Jacobian over its columns:
# 0.03 for two parameters of correlation 0.999. One-sided differences err by 1e-3, central ones by 1e-6.
HALF_WIDTH = 3e-7
# Motions that are kept: at the end of a fit the residuals, the contacts and the cost are asked for of the same motion.
KEPT = 8

Job = Callable[[], np.ndarray]


def one_by_one(jobs: Sequence[Job]) -> list[np.ndarray]:
    """Return the values (...) of all ``jobs``, which this rank computes alone."""
    return [job() for job in jobs]


class Misfit:
    """Residuals of the ``records`` of a ``plan`` over their noise, (model - measured)/``noise``.

    ``noise`` has one array (sensor,) a record, in SI units; a new misfit has the ``sizes`` of the channels there, root
    mean squares. The ``size`` coordinates z (coordinate,) are those of the parameters, then those of the initial states
    that are estimated, ``states`` by the number of the record. ``watched`` (record) are the masses (sensor,) at which
    the sensors are. ``compute`` returns the values of jobs that do not depend on each other: ranks may share them.
    """

    def __init__(
        self,
        plan: IdentifyCase,
        records: Sequence[Measured],
        compute: Callable[[Sequence[Job]], list[np.ndarray]] = one_by_one,
    ) -> None:
        self.plan = plan
        self.records = records
        self.compute = compute
        self._trials = [plan.trials(number) for number in range(len(records))]
        self._kept_motion = lru_cache(maxsize=KEPT)(self._new_motion)
        self.sizes = [np.sqrt(np.mean(record.values**2, axis=0)) for record in records]
        self.noise = list(self.sizes)
        base = plan.base
        dofs = base.lattice.unit_cell().dofs
        self.watched = []
        for table in plan.options.records:
            # A sensor of the drive's force has no mass: the first one holds its place.
            masses = [0] * len(table.sensors)
            for i, sensor in enumerate(table.sensors):
                if sensor.cell is not None:
                    masses[i] = (sensor.cell - 1) * dofs + (sensor.mass or 1) - 1
            self.watched.append(masses)

        self.states: dict[int, InitialState] = {}
        self.size = len(plan.parameters)
        for number, table in enumerate(plan.options.records):
            if table.initial == "estimate":
                sensors = [
                    (mass, ROWS[sensor.quantity], float(size))
                    for mass, sensor, size in zip(self.watched[number], table.sensors, self.noise[number], strict=True)
                    if sensor.quantity != "force"
                ]
                state = initial_state(self._trials[number].base.model(), self.size, sensors)
                self.states[number] = state
                self.size = state.stop

    @property
    def count(self) -> int:
        """The number of parameters."""
        return len(self.plan.parameters)

    def model(self, z: np.ndarray, number: int) -> Model:
        """Return model of record ``number`` (from 0) at ``z`` (coordinate,); raises CaseError if it is impossible."""
        return self._trials[number].case(self.values(z)).model()

    def values(self, z: np.ndarray) -> np.ndarray:
        """Return the values (parameter,) at the coordinates ``z`` (coordinate,)."""
        parameters = self.plan.parameters
        return np.array([p.from_coordinate(x) for p, x in zip(parameters, z[: self.count], strict=True)])

    def offset(self, z: np.ndarray, number: int) -> float:
        """Return the time in s of the record ``number``'s clock at which its drive begins, at ``z`` (coordinate,)."""
        offset = self.plan.options.records[number].offset
        if not isinstance(offset, list):
            return offset
        values = self.values(z)
        return next(
            float(value)
            for parameter, value in zip(self.plan.parameters, values, strict=True)
            if parameter.quantity == "offset" and parameter.members == (number,)
        )

    def motion(self, z: np.ndarray, number: int, end: float) -> RecordedMotion:
        """Return motion of record ``number`` at ``z`` (coordinate,), at its sensors, up to ``end`` in s of its clock.

        The latest ``KEPT`` motions are kept. Raises CaseError, MotionError.
        """
        # One sample has no interval.
        samples = max(int(np.sum(self.records[number].times <= end)), 2)
        return self._kept_motion(tuple(z.tolist()), number, samples)

    def _new_motion(self, z: tuple[float, ...], number: int, samples: int) -> RecordedMotion:
        """Return the ``motion`` at ``z`` over so many ``samples``, computed; a cache needs a tuple of numbers."""
        return self.respond(np.array(z), number, self.watched[number], self.records[number].times[:samples])

    def respond(self, z: np.ndarray, number: int, watched: Sequence[int], times: np.ndarray) -> RecordedMotion:
        """Return the motion of record ``number`` at ``z`` (coordinate,), of the masses ``watched`` (mass,).

        It is sampled at the even ``times`` (sample,) in s of the record's clock, from its first one on. Raises
        CaseError, MotionError.
        """
        case = self._trials[number].case(self.values(z))
        touches = self.plan.options.records[number].contact
        sampled = SampledModel(case, case.model(), watched, touches)
        return sampled.respond(times, self.offset(z, number), self._state(z, number))

    def _state(self, z: np.ndarray, number: int) -> State | None:
        """Return the state at the first sample of record ``number``, at ``z`` (coordinate,), if it is estimated."""
        state = self.states.get(number)
        if state is None:
            return None
        chain = self.plan.base.model().chain
        displacement, velocity = (state.matrix @ z[state.indices]).reshape(2, chain.cells, chain.cell.dofs)
        return displacement, velocity

    def predicted(self, z: np.ndarray, number: int, end: float) -> np.ndarray:
        """Return values of the model at the sensors of a record (sample, sensor), at ``z`` (coordinate,).

        ``end`` in s is a time of the record's clock. Raises CaseError, MotionError.
        """
        samples = int(np.sum(self.records[number].times <= end))
        motion = self.motion(z, number, end).motion[:samples]
        values = np.zeros(motion.shape[:2])
        for k, sensor in enumerate(self.plan.options.records[number].sensors):
            if sensor.quantity == "force":
                values[:, k] = self._force(z, number, end, sensor)
            else:
                values[:, k] = motion[:, k, ROWS[sensor.quantity]]
        return values

    def _force(self, z: np.ndarray, number: int, end: float, sensor: SensorTable) -> np.ndarray:
        """Return the force (sample,) in N of the drive at a ``sensor`` of record ``number``, at ``z`` (coordinate,)."""
        case = self._trials[number].case(self.values(z))
        model = case.model()
        # The model has a drive for each spring to a moved wall, and so may have more of them than the case.
        place = first_built(case.drive, model.chain)[(sensor.drive or 1) - 1]
        times = self.records[number].times
        since = times[times <= end] - self.offset(z, number)
        drives = create_drives(model.drives, range(len(model.drives)))
        # Before its beginning there is no drive.
        return drive_forces(drives, since)[place] * (since > 0)

    def residuals(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
        """Return residuals (datum,) over the noise at ``z`` (coordinate,), up to ``ends`` (record,) in s.

        Data are ordered by record, sample, sensor; a record with an end of -inf is left out. Residuals of a record are
        ``REJECTED``, or more if the noise is very small, where the model is impossible or its motion cannot be
        followed.
        """

        def residuals_of(number: int) -> np.ndarray:
            record = self.records[number]
            measured = record.values[record.times <= ends[number]]
            try:
                values = self.predicted(z, number, ends[number])
            except (CaseError, MotionError):
                rejected = np.maximum(REJECTED, REJECTED_SIZE * self.sizes[number] / self.noise[number])
                return np.broadcast_to(rejected, measured.shape).ravel()
            return np.asarray((values - measured) / self.noise[number]).ravel()

        return np.concatenate(self.compute([partial(residuals_of, number) for number in self._used(ends)]))

    def jacobian(
        self, z: np.ndarray, ends: Sequence[float], active: Sequence[int], is_rough: bool = False
    ) -> np.ndarray:
        """Return derivatives (datum, active) of ``residuals``, rough or exact; raises CaseError, MotionError."""

        def column(number: int, p: int) -> np.ndarray:
            slope = self.difference(z, p, partial(self.predicted, number=number, end=ends[number]), is_rough)
            return np.asarray(slope / self.noise[number]).ravel()

        wanted = [(number, p) for number in self._used(ends) for p in active if self.acts_on(p, number)]
        columns = self.compute([partial(column, number, p) for number, p in wanted])

        blocks = []
        for number in self._used(ends):
            samples = int((self.records[number].times <= ends[number]).sum())
            block = np.zeros((samples * len(self.watched[number]), len(active)))
            for (owner, p), values in zip(wanted, columns, strict=True):
                if owner == number:
                    block[:, list(active).index(p)] = values
            blocks.append(block)
        return np.concatenate(blocks)

    def difference(
        self, z: np.ndarray, p: int, function: Callable[[np.ndarray], np.ndarray], is_rough: bool = False
    ) -> np.ndarray:
        """Return the derivative of a ``function`` of the coordinates by coordinate ``p``, at ``z`` (coordinate,).

        It is a central difference; a rough one is between ``z``, where the motion is known, and a coordinate above. At
        a bound both are between the bound and a coordinate inside.
        """
        low = -np.inf
        high = np.inf
        if p < self.count:
            parameter = self.plan.parameters[p]
            low = parameter.to_coordinate(parameter.low)
            high = parameter.to_coordinate(parameter.high)

        below = z.copy()
        above = z.copy()
        above[p] = min(z[p] + HALF_WIDTH, high)
        if not is_rough or above[p] - z[p] < HALF_WIDTH / 2:
            below[p] = max(z[p] - HALF_WIDTH, low)
        return (function(above) - function(below)) / (above[p] - below[p])

    def acts_on(self, p: int, number: int) -> bool:
        """Return whether the motion or the clock of record ``number`` may depend on coordinate ``p``."""
        if p >= self.count:
            state = self.states.get(number)
            return state is not None and p in state.indices
        parameter = self.plan.parameters[p]
        return parameter.quantity != "offset" or parameter.members == (number,)

    def cost(self, z: np.ndarray, ends: Sequence[float]) -> float:
        """Return sum of squares at ``z`` (coordinate,) of residuals over the noise and of the initial states' prior.

        The residuals are those up to ``ends`` (record,) in s.
        """
        data = self.residuals(z, ends)
        return float(np.sum(data**2)) + float(np.sum((self.prior() @ z) ** 2))

    def _used(self, ends: Sequence[float]) -> list[int]:
        """Return the numbers of the records that have samples up to ``ends``."""
        return [n for n, (record, end) in enumerate(zip(self.records, ends, strict=True)) if record.times[0] <= end]

    def prior(self) -> np.ndarray:
        """Return slopes (state coordinate, coordinate) of the prior's residuals, which are coordinates over ``WIDTH``.

        They keep initial states finite.
        """
        return np.eye(self.size)[self.count :] / WIDTH

    def whole_jacobian(self, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
        """Return the ``jacobian`` (residual, coordinate), with the rows of the ``prior`` behind those of data."""
        return np.vstack([self.jacobian(z, ends, range(self.size)), self.prior()])
