"""The flow of a lattice with contacts and its linearisation, distributed over ranks, without a matrix of its size.

It is the engine of exact steps, ``dynamics.propagator``, and not Runge-Kutta stepping: between contacts a variation of
the state moves as the state does, by P(H), and in contact a step is linearised through the few numbers by which a
cluster of sites feels the lattice (``dynamics.propagator.tangent``). The orbit is integrated once, with its contacts
located on all ranks from the same numbers; any number of variations is then propagated along it without another
search, in compiled code. Displacements, contacts and variations have the same bits on any number of ranks.

States are blocks (2 mass, owned cell), displacements in m before velocities in m/s, mass by mass as in
``dynamics.layout``; ``scatter`` and ``gather`` go from and to the order of ``modes.system``, cell by cell.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.dynamics.propagator.step_choice import LARGEST_OMEGA_H
from vipetsc.dynamics.propagator.tangent import MOST_TAPE_ROWS, TangentPropagator
from vipetsc.lattice import Chain, Contact, Drive, ToneBurst
from vipetsc.modes.balance.stops import Stops
from vipetsc.modes.departures import union_length
from vipetsc.modes.flow import ArcLimits
from vipetsc.modes.problem import FlowError
from vipetsc.parallel import StoppedError

# Errors allowed in a contact's substep, relative to its speed: below the 1e-12 to which orbits of lattices are
# corrected.
RTOL = 1e-13
# Errors are relative to the largest speed at the start of the orbit. The scale is at least this fraction of the speed
# that the largest displacement would have in the fastest linear mode, since an orbit may start at rest.
SLOWEST = 0.1
# Steps between two looks at requests to stop, times cells: a fraction of a second.
CELLS_BETWEEN_LOOKS = 1_000_000


@dataclass(eq=False)
class LatticeArc:
    """A piece of an orbit of ``duration`` seconds between the blocks ``start`` and ``end``.

    ``departures`` (number, 2) are begin and end in s of each time that a contact is closed, or open if it is pressed at
    rest; ``closed`` is the time in s with a contact closed; ``steps`` counts the linear steps.
    """

    duration: float
    start: np.ndarray
    end: np.ndarray
    departures: np.ndarray
    closed: float
    steps: int
    engine: TangentPropagator

    @property
    def episodes(self) -> int:
        """The number of contacts that are closed at the start or begin, and of openings of pressed ones."""
        return len(self.departures)

    def spans(self) -> list[tuple[float, float]]:
        """Begin and end in s of every episode, on all ranks alike."""
        return [(begin, end) for begin, end in self.departures.tolist()]

    def move(self, variations: np.ndarray) -> np.ndarray:
        """Variations (variation, 2 mass, owned cell) of the end, given those of the start; all ranks must call it."""
        return self.engine.move(variations)


class LatticeFlow:
    """The flow of ``chain``, whose sites have the elastic ``stops``, without drive, on the ranks of ``comm``."""

    def __init__(self, chain: Chain, stops: Sequence[Stops], comm: MPI.Comm) -> None:
        self.chain = chain
        self.comm = comm
        self._laws = tuple(of_site.law for of_site in stops)
        gaps = tuple((of_site.plus, of_site.minus) for of_site in stops)
        # ``Model`` takes clearances from the chain where those of every site are equal on both sides.
        self._gaps: tuple[tuple[float, float], ...] = ()
        if any(plus != minus for plus, minus in gaps):
            self._gaps = gaps
        self.layout = Layout(self._model(1.0, 1), comm)
        self.limits = ArcLimits(every=max(CELLS_BETWEEN_LOOKS // chain.cells, 1), comm=comm)
        self._omega = StepSeries(chain, 1.0, RTOL).omega_max_h

    def _model(self, duration: float, samples: int) -> Model:
        """The lattice at rest and without a drive, over ``duration`` seconds with so many ``samples``."""
        still = ToneBurst(amplitude=0.0, frequency=1e-3 / duration, cycles=1)
        laws: tuple[Contact, ...] = ()
        if len(set(self._laws)) > 1:
            laws = self._laws
        return Model(
            chain=self.chain,
            contact=self._laws[0],
            drives=(Drive(still, cell=0, mass=0),),
            end=duration,
            sample_interval=duration / samples,
            method="8vr",
            rtol=RTOL,
            atol=(0.0, 0.0),
            scale=1.0,
            packet=np.inf,
            laws=laws,
            gaps=self._gaps,
        )

    def arc(self, start: np.ndarray, duration: float) -> LatticeArc:
        """The orbit from the block ``start`` (2 mass, owned cell) over ``duration`` seconds; all ranks must call it.

        Raises FlowError on all ranks.
        """
        self.limits.refuse(self._omega * duration / LARGEST_OMEGA_H)
        steps = self.steps(duration)
        engine, end = self._run(start, duration, steps)
        contacts = engine.contacts()
        closed = union_length(np.concatenate(self.comm.allgather(contacts.closed_substeps)))
        departures = np.concatenate(self.comm.allgather(contacts.departures))
        return LatticeArc(duration, start, end, departures, closed, steps, engine)

    def steps(self, duration: float, largest: float = LARGEST_OMEGA_H) -> int:
        """The steps of an arc of ``duration`` seconds, each at most ``largest`` radians of the fastest motion."""
        return max(int(np.ceil(self._omega * duration / largest)), 1)

    def watch(self, start: np.ndarray, duration: float, steps: int, look: Callable[[np.ndarray], None]) -> None:
        """Call ``look`` with the block (2 mass, owned cell) ``start`` of an arc, and with the block after each step.

        The arc of ``duration`` seconds has so many ``steps``. All ranks must call it. Raises FlowError on all ranks.
        """
        look(start)
        engine, _ = self._run(start, duration, steps, look)
        engine.destroy()

    def _run(
        self, start: np.ndarray, duration: float, steps: int, look: Callable[[np.ndarray], None] | None = None
    ) -> tuple[TangentPropagator, np.ndarray]:
        """The engine that has run an orbit in so many ``steps``, and the block at its end.

        The engine keeps the orbit on a tape, along which it can move variations, unless ``look`` is called.
        """
        model = self._model(duration, steps)
        why = TangentPropagator.refusal(model)
        if why:
            raise FlowError(f'{why}; nnm.shooting = "dense" does without such steps')

        tape_rows = MOST_TAPE_ROWS
        if look:
            tape_rows = 0
        engine = TangentPropagator(model, self.layout, tape_rows)
        largest = np.zeros(len(start))
        if start.size:
            largest = np.abs(start).max(axis=1, initial=0.0)
        # The same scale on all ranks, or substeps and with them the bits would depend on their number.
        self.comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        u, v = np.split(largest, 2)
        try:
            engine.place(start, max(float(v.max()), SLOWEST * self._omega * float(u.max())))
            end = engine.run(steps, look, self.limits.check)
            self.limits.check(steps)
        # These are raised on all ranks; any other error may be one rank's own, and is not caught.
        except StoppedError:
            engine.destroy()
            raise
        except StalledError as error:
            engine.destroy()
            raise FlowError(f"the orbit of {duration:.6g} s stops: {error}") from error
        return engine, end

    def scatter(self, state: np.ndarray) -> np.ndarray:
        """The rank's block of a ``state`` (..., 2n) of the whole lattice."""
        layout = self.layout
        cells = state.reshape(*state.shape[:-1], 2, layout.cells, layout.dofs)[..., layout.start : layout.stop, :]
        return np.moveaxis(cells, -1, -2).reshape(*state.shape[:-1], 2 * layout.dofs, layout.owned).copy()

    def gather(self, block: np.ndarray) -> np.ndarray:
        """The state (..., 2n) of the whole lattice from the ``block`` of every rank, on all of them."""
        cells = np.concatenate(self.comm.allgather(block), axis=-1)
        halves = cells.reshape(*block.shape[:-2], 2, self.layout.dofs, self.layout.cells)
        return np.moveaxis(halves, -1, -2).reshape(*block.shape[:-2], -1).copy()
