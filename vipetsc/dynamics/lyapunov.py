"""The largest Lyapunov exponent of a run: how fast a second run that begins beside it goes away, or comes closer.

The exponent is the mean rate at which a small deviation d of the state grows,

    lambda = 1/T sum_i log(|d_i| / d_0),

where the deviation of a second run, the companion, is brought back to its first size d_0 after each interval i, in the
direction that it has (Benettin, Galgani, Giorgilli and Strelcyn 1980). The companion is advanced by the same engine, so
that contacts of both laws, nonlinear springs and dashpots are all in the exponent. Impacts need nothing more (Stefanski
2000): where the two runs have not the same contacts closed, the companion goes on for another interval. So it does
while a site sticks to a rigid stop, whose deviation has nowhere to go.

**Size.** |d| is the largest |v| or Om |u| of any mass, Om the frequency of the intervals: all norms have one exponent,
and the ranks agree on this one to the last bit. d_0 is ``SIZE`` of the largest |(u, v)| so far. The difference of two
runs has errors of about 1e-10 of the state by the engines' tolerance, and is proportional to d_0 up to terms in d_0^2.

**Times.** The companion begins as soon as anything moves. The mean is taken over the second half of the run, the same
that pictures of Poincare sections show: until then the deviation turns to the direction that grows fastest. What is
kept of an interval does not depend on the end of the run, which may be extended. Where a mass comes to rest at its stop
and the deviation vanishes, the mean begins anew: it is that of the motion since then, and where masses rest again and
again there are too few intervals for a number.

References
----------
G. Benettin, L. Galgani, A. Giorgilli, J. M. Strelcyn, Lyapunov characteristic exponents for smooth dynamical systems
and for Hamiltonian systems, Meccanica 15 (1980) 9-30.
A. Stefanski, Estimation of the largest Lyapunov exponent in systems with impacts, Chaos, Solitons and Fractals 11
(2000) 2443-2451.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.contact.law import STUCK
from vipetsc.dynamics.engine import Engine
from vipetsc.dynamics.observers import Observer, Setup
from vipetsc.dynamics.options import petsc_options
from vipetsc.dynamics.samples import Block, Samples

# The deviation's first size, of the largest state so far.
SIZE = 1e-6
# Of the run: when the growth begins to count.
COUNTS_FROM = 0.5
# The mean of fewer intervals is not worth a number.
LEAST_INTERVALS = 16
# Parts of the second half, whose exponents give the error.
PARTS = 4
# Samples of an interval where no wave has a period, as of a pulse.
INTERVAL_SAMPLES = 20


class LargestExponent(Observer):
    """Advances a companion of the run, and keeps the growth of its deviation in each interval.

    ``growth`` (interval, 3) has the end and the duration of each interval in s, and log |d|/d_0.
    """

    name = "lyapunov"
    saved = ("largest", "size", "last")
    largest = 0.0
    size = 0.0  # of the deviation at the time ``last`` in s
    last = 0.0

    def begin(self, setup: Setup) -> None:
        super().begin(setup)
        model = setup.model
        self.longest = INTERVAL_SAMPLES
        if np.isfinite(model.packet) and model.packet > 0:
            self.longest = max(1, round(2 * np.pi / model.packet / model.sample_interval))
        self.growth: list[tuple[float, float, float]] = []
        self._frequency = 2 * np.pi / (self.longest * model.sample_interval)
        self._companion: Engine | None = None
        # Without a reason the companion goes on.
        self._reason = ""

    def observe(self, block: Block) -> None:
        if self._reason:
            return
        if self._companion is not None:
            filled = self._companion.fill(_nothing_of(block.samples, len(block)))
            # What has been taken is not logged: these impacts are not those of the run.
            self._companion.take_episodes()
            if filled.stalled:
                self._reason = f"the run beside it: {filled.stalled}"
                return

        # Blocks end with an interval, but for the one in which a run stops on request.
        ended = block.first + len(block)
        if ended % self.longest:
            return
        cells = self.setup.engine.checkpoint()["cells"]
        self.largest = max(self.largest, self._norm(cells))
        if self._companion is not None:
            self._compare(cells, float(block.times[-1]))
        elif self.largest > 0 and not self._sticks():
            self._begin_companion(cells)
            self.last = float(block.times[-1])

    def _sticks(self) -> bool:
        """Return whether a site of the run sticks to a rigid stop; all ranks must call it."""
        modes = self.setup.engine.checkpoint()["sites"]["mode"]
        return any(self.setup.layout.comm.allgather(bool(np.any(np.abs(modes) == STUCK))))

    def _norm(self, cells: np.ndarray) -> float:
        """Return the size of a state or a deviation, from the own ``cells`` (cell, 2 dof); all ranks must call it."""
        displacements, velocities = np.split(np.abs(cells), 2, axis=1)
        largest = max(velocities.max(initial=0.0), self._frequency * displacements.max(initial=0.0))
        return float(self.setup.layout.comm.allreduce(float(largest), MPI.MAX))

    def _begin_companion(self, cells: np.ndarray) -> None:
        """Begin the companion where the run is, and move its ``cells`` (cell, 2 dof) in a direction drawn at random."""
        # Drawn for the whole lattice, so that it does not depend on the ranks.
        layout = self.setup.layout
        drawn = np.random.default_rng(0).standard_normal((layout.cells, cells.shape[1]))
        direction = drawn[layout.start : layout.stop]
        direction[:, : cells.shape[1] // 2] /= self._frequency
        self.size = SIZE * self.largest
        moved = cells + direction * (self.size / self._norm(direction))
        self._continue_companion([self.setup.engine.checkpoint() | {"cells": moved}])

    def _continue_companion(self, here: Sequence[Mapping[str, np.ndarray]]) -> None:
        """Let the companion go on from this rank's parts ``here`` of a checkpoint, in order; all ranks must call it."""
        engine = self.setup.engine
        if self._companion is None:
            with petsc_options(self.setup.case.petsc_options):
                self._companion = type(engine)(self.setup.model, self.setup.layout)
        parts = [part for of_rank in self.setup.layout.comm.allgather(here) for part in of_rank]
        self._companion.restore(parts)

    def _compare(self, cells: np.ndarray, time: float) -> None:
        """Take the growth of the deviation from the run's ``cells`` up to the ``time`` in s, and bring it back."""
        assert self._companion is not None
        if self._sticks():
            return
        of_run = self.setup.engine.checkpoint()["sites"]
        of_companion = self._companion.checkpoint()
        same = bool(np.array_equal(of_run["mode"], of_companion["sites"]["mode"]))
        if not all(self.setup.layout.comm.allgather(same)):
            return

        deviation = of_companion["cells"] - cells
        grown = self._norm(deviation)
        if grown == 0:
            # A mass that rests at its stop forgets where it came from. What follows may be chaotic all the same.
            self.growth = []
            self.last = time
            self._begin_companion(cells)
            return
        self.growth.append((time, time - self.last, float(np.log(grown / self.size))))
        self.last = time
        self.size = SIZE * self.largest

        # A contact that is closed has the velocity of its approach as a further part of its state.
        scale = self.size / grown
        approach = of_run["approach"]
        of_companion["sites"]["approach"] = approach + scale * (of_companion["sites"]["approach"] - approach)
        self._continue_companion([of_companion | {"cells": cells + scale * deviation}])

    def checkpoint(self) -> dict[str, np.ndarray]:
        state = super().checkpoint()
        state["growth"] = np.array(self.growth).reshape(-1, 3)
        state["reason"] = np.frombuffer(self._reason.encode(), np.uint8)
        if self._companion is None:
            return state
        for rank, part in enumerate(self.setup.layout.comm.allgather(self._companion.checkpoint())):
            state |= {f"companion-{rank}/{key}": value for key, value in part.items()}
        return state

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        super().restore(state)
        self.growth = [(time, duration, growth) for time, duration, growth in state["growth"].tolist()]
        self._reason = state["reason"].tobytes().decode()

        parts: list[dict[str, np.ndarray]] = []
        while any(key.startswith(f"companion-{len(parts)}/") for key in state):
            prefix = f"companion-{len(parts)}/"
            parts.append({key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)})
        if parts:
            # All ranks have all parts: one of them gives them to the others.
            here = parts
            if self.setup.layout.comm.rank > 0:
                here = []
            self._continue_companion(here)

    def finish(self, stopped: bool) -> None:
        if self._companion is not None:
            self._companion.destroy()

    def statistics(self) -> dict[str, Any]:
        """Return ``lyapunov`` in 1/s, the largest exponent, and ``lyapunov_error``, the standard error of its mean."""
        if self._why_none():
            return {}
        counted = self._counted()
        rates = []
        for part in np.array_split(counted, PARTS):
            _, durations, growths = part.T
            rates.append(growths.sum() / durations.sum())
        _, duration, growth = counted.sum(axis=0)
        return {"lyapunov": float(growth / duration), "lyapunov_error": float(np.std(rates, ddof=1) / np.sqrt(PARTS))}

    def _counted(self) -> np.ndarray:
        """Return the rows of ``growth`` in the part of the run that counts."""
        growth = np.array(self.growth).reshape(-1, 3)
        return growth[growth[:, 0] > COUNTS_FROM * self.setup.model.end]

    def _why_none(self) -> str:
        """Return the reason for which the run has no exponent; empty where it has one."""
        intervals = len(self._counted())
        if self._reason or intervals >= LEAST_INTERVALS:
            return self._reason
        return (
            f"{intervals} intervals lie in the second half of the run, and {LEAST_INTERVALS} are needed; raise time.end"
        )

    def warnings(self) -> list[str]:
        """Return a sentence on why there is no exponent."""
        why = self._why_none()
        if why:
            return [f"no Lyapunov exponent: {why}"]
        return []


def _nothing_of(samples: Samples, count: int) -> Samples:
    """Return room for the first ``count`` of ``samples`` with what every sample has, and without fields."""
    return samples._replace(
        sums=np.zeros_like(samples.sums[:count]),
        work=np.zeros_like(samples.work[:count]),
        losses=np.zeros_like(samples.losses[:count]),
        fields=np.zeros((0, 0, 0, 0)),
        forces=np.zeros((0, samples.forces.shape[1])),
        motion=np.zeros((count, samples.motion.shape[1], 0)),
        watched=samples.watched[:0],
        pushes=samples.pushes[:0],
    )
