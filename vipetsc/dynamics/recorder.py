"""The observer ``recorder``, which collects fields, energies and episodes and passes them to the output in chunks.

An engine fills the arrays of ``next_samples`` in place with a block of samples; ``observe`` takes note of them. Chunks
have a bounded size, since a run may be longer than memory, and each is written once. Rank 0 gathers the parts of all
ranks.
"""

import sys
from typing import Any

from mpi4py import MPI

import numpy as np

from vipetsc.case import Model
from vipetsc.case.contacts import has_equal_sides
from vipetsc.case.points import PointTable
from vipetsc.dynamics.energies import ENERGY_SUMS
from vipetsc.dynamics.observers import Observer, Setup
from vipetsc.dynamics.points import PointMotion
from vipetsc.dynamics.recorded_sizes import CHUNK_SAMPLES, chunk_samples, recorded_cells
from vipetsc.dynamics.samples import Block, Samples
from vipetsc.io.chunks import DAMPED, FORCES, LOSSES, MOTION, SAMPLED, Recording

# Samples of all cells, each as large as a state, after which a checkpoint follows: it adds a quarter to the bytes.
SAMPLES_A_STATE = 4
# Of each of the energies in a file, by its name in ``Energies``.
ENERGIES = {name.removeprefix("energy/"): name for name in (*SAMPLED, DAMPED) if name.startswith("energy/")}


class Recorder(Observer):
    """Keeps the fields that the case asks for, the energies and the contact episodes, and writes them in chunks."""

    name = "recorder"
    saved = ("episodes", "deepest")
    episodes = 0
    deepest = 0.0  # indentation in m
    unsaved_samples = 0  # in chunks since the last checkpoint
    last_onset = np.inf  # in s, after a failure: engines finish their block, whose later part is no solution

    def begin(self, setup: Setup) -> None:
        super().begin(setup)
        layout = setup.layout
        output = setup.case.output
        recorded = np.array(recorded_cells(output, setup.model.chain.cells))
        first, stop = np.searchsorted(recorded, [layout.start, layout.stop]).tolist()
        local = recorded[first:stop] - layout.start

        self._of_sites: tuple[str, ...] = (LOSSES,)
        if output.forces:
            self._of_sites = (LOSSES, FORCES)
        self._energies = [energy for energy, name in ENERGIES.items() if name != DAMPED or setup.model.chain.is_damped]
        sampled = ["time", "field_time", *(ENERGIES[energy] for energy in self._energies)]
        points = output.points or []
        self._points: PointMotion | None = None
        self._watched = np.zeros((0, 2), np.int64)
        self._pushes = np.zeros((0, 3), np.int64)
        if points:
            self._points = PointMotion(points, setup.model.chain, layout)
            self._watched = self._points.watched
            self._pushes = self._points.pushes
            sampled += MOTION
        setup.output.recording = Recording(
            given=_coordinates(setup.model, recorded) | _places(points),
            fields=tuple(output.fields),
            rows=-(-setup.model.samples // output.stride),
            sampled=sampled,
            of_sites=self._of_sites,
        )

        self._sample_numbers = len(output.fields) * layout.dofs * len(recorded) // output.stride
        numbers = len(output.fields) * layout.dofs * local.size + len(self._of_sites) * len(layout.sites)
        # Rank 0 keeps the chunks that it gathers from all ranks.
        most = layout.comm.allreduce(numbers, MPI.SUM)
        length = setup.output.chunk_length or chunk_samples(8 * most)
        # One more than there are samples: a chunk that is full at the end would have an empty one behind it.
        self._length = min(length, setup.model.samples + 1)
        self._stride = output.stride
        self._shape = self._length, len(output.fields), layout.dofs, local.size
        # 1 for each field of velocities, which engines take from the second half of the state.
        self._moving = np.array([name == "velocity" for name in output.fields], np.int64)
        self._first = 0
        if local.size:
            self._first = int(local[0])
        self._begin_chunk()

    def _begin_chunk(self) -> None:
        """Allocate the arrays of a chunk of samples."""
        n = self._length
        # Samples and recorded rows (every ``stride``-th sample) in the chunk so far, and the number of its first
        # sample.
        self._held = 0
        self._rows = 0
        self._number = 0
        self._sums = np.zeros((n, ENERGY_SUMS, 2), np.int64)
        self._work = np.zeros((n, len(self.setup.model.drives)))
        sites = len(self.setup.layout.sites)
        self._losses = np.zeros((n, sites))

        # Engines do not fill empty arrays.
        self._forces = np.zeros((0, sites))
        if FORCES in self._of_sites:
            self._forces = np.zeros((n, sites))
        self._motion = np.zeros((n, 3, len(self._watched)))
        self._kept = {name: np.zeros(n) for name in ("time", *(ENERGIES[energy] for energy in self._energies))}
        self._fields = self.setup.output.fields_of_chunk(self._shape)

    def next_samples(self, number: int, most: int) -> Samples:
        """Return arrays for the samples from ``number`` on: as many as fit in the chunk, and ``most`` at most."""
        meter = self.setup.meter
        output = self.setup.case.output
        here = slice(self._held, self._held + most)
        return Samples(
            number=number,
            sums=self._sums[here],
            work=self._work[here],
            losses=self._losses[here],
            fields=self._fields[self._rows : self._rows + most],
            moving=self._moving,
            first_cell=self._first,
            every=output.every,
            stride=output.stride,
            lattice=self.setup.engine.lattice,
            unit=meter.unit,
            interval=self.setup.model.sample_interval,
            forces=self._forces[here],
            motion=self._motion[here],
            watched=self._watched,
            pushes=self._pushes,
        )

    def observe(self, block: Block) -> None:
        here = slice(self._held, self._held + len(block))
        self._kept["time"][here] = block.times
        for energy in self._energies:
            self._kept[ENERGIES[energy]][here] = getattr(block.energies, energy)

        self._number = block.first - self._held
        self._held = here.stop
        self._rows += block.samples.recorded_rows(len(block))

    @property
    def due(self) -> bool:
        """Whether the chunk is full."""
        return self._held == self._length

    @property
    def is_state_due(self) -> bool:
        """Whether a checkpoint should follow the last chunk: a state is as large as some samples of a long lattice."""
        layout = self.setup.layout
        every = SAMPLES_A_STATE * -(-int(layout.offsets[-1]) // max(self._sample_numbers, 1))
        return not self.setup.output.folder or self.unsaved_samples >= min(every, CHUNK_SAMPLES)

    def flush(self, last: bool = False) -> None:
        """Write the samples collected so far and this rank's closed episodes as a chunk.

        Fields, losses and episodes are those of a rank's own cells and sites, or on rank 0 of all (see ``io.chunks``);
        the ``last`` chunk has the episodes that are still open, too. The chunk of rank 0 also has times and energies.
        """
        sys.audit("vipetsc.flush")
        comm = self.setup.layout.comm
        output = self.setup.output
        episodes = self.setup.engine.take_episodes(unfinished=last)
        # Engines finish the block in which a run fails: episodes after the failure are no solution.
        episodes = episodes[episodes["onset"] <= self.last_onset]

        chunk = self._gather(episodes)
        if self._points:
            chunk |= self._points.gather(self._motion[: self._held])
        if comm.rank == 0:
            chunk |= {name: values[: self._held] for name, values in self._kept.items()}
            # Rows of fields are the samples whose number in the run is a multiple of the stride.
            chunk["field_time"] = chunk["time"][-self._number % self._stride :: self._stride]
        output.append(chunk)

        self.unsaved_samples += self._held
        self.episodes += comm.allreduce(len(episodes))
        self.deepest = comm.allreduce(max([self.deepest, *episodes["indentation"].tolist()]), MPI.MAX)
        self._begin_chunk()

    def _gather(self, episodes: np.ndarray) -> dict[str, np.ndarray]:
        """Return fields, losses and ``episodes`` of the chunk of all ranks, on rank 0; nothing on the others."""
        comm = self.setup.layout.comm
        recording = self.setup.output.recording
        sites = np.array(self.setup.layout.sites, np.int64)
        of_sites = [self._losses[: self._held]]
        if FORCES in self._of_sites:
            of_sites.append(self._forces[: self._held])
        gathered = comm.gather((sites, np.array(of_sites), episodes))
        all_cells = self._gather_fields()
        if gathered is None:
            return {}

        all_sites, all_of_sites, all_episodes = zip(*gathered, strict=True)
        numbers = np.concatenate(all_sites)
        order = np.argsort(numbers)
        log = np.concatenate(all_episodes)
        log["site"] += 1  # counted from 1
        chunk = {"impacts": log}
        chunk |= dict(zip(self._of_sites, np.concatenate(all_of_sites, axis=2)[:, :, order], strict=True))
        return chunk | dict(zip(recording.fields, all_cells.swapaxes(0, 1), strict=True))

    def _gather_fields(self) -> np.ndarray:
        """Return fields (row, field, dof, cell) of the chunk of all ranks, on rank 0; the others return their own."""
        comm = self.setup.layout.comm
        part = self._fields[: self._rows]
        # One rank's fields may be large: they are not copied.
        if comm.size == 1:
            return part
        counts = comm.gather(part.shape[3])
        if counts is None:
            comm.Send(part, 0)
            return part

        # What comes from a rank is put where its cells are, without a copy in between.
        fields = np.empty((*part.shape[:3], sum(counts)))
        fields[..., : counts[0]] = part
        first = counts[0]
        for rank, count in enumerate(counts[1:], start=1):
            if fields.size and count:
                cells = MPI.DOUBLE.Create_subarray(fields.shape, [*part.shape[:3], count], [0, 0, 0, first]).Commit()
                comm.Recv([fields, 1, cells], source=rank)
                cells.Free()
            else:
                comm.Recv(np.empty(0), source=rank)
            first += count
        return fields

    def finish(self, stopped: bool) -> None:
        if not stopped:
            self.flush(last=True)

    def statistics(self) -> dict[str, Any]:
        """Return the number of contact episodes logged, the deepest indentation in m, and a note if there were none."""
        statistics: dict[str, Any] = {"episodes": self.episodes, "deepest_indentation": self.deepest}
        if note := self._note_on_contacts():
            statistics["contact_note"] = note
        return statistics

    def _note_on_contacts(self) -> str:
        """Return a sentence on sites none of which made contact; empty if one did, or without sites."""
        sites = len(self.setup.model.chain.sites)
        if self.episodes or not sites:
            return ""

        touching = np.count_nonzero(self.setup.model.chain.sites.gaps.min(axis=1) <= 0)
        if touching > 1:
            return f"no contact: nothing pressed any of the {touching} sites that touch their stops at rest"
        if touching:
            return "no contact: nothing pressed the site that touches its stop at rest"
        if sites > 1:
            return f"no contact: nothing reached any of the {sites} sites"
        return "no contact: nothing reached the site"

    def warnings(self) -> list[str]:
        """Return sentences on sites without contact, and on indentations beyond the range of Hertz's theory."""
        if note := self._note_on_contacts():
            return [note]

        radius = self.setup.case.contact_radius
        is_hertz = any(law.law == "hertz" for law in self.setup.model.chain.sites.laws)
        if radius is None or not is_hertz or self.deepest <= radius:
            return []
        beyond = f"the deepest indentation, {self.deepest:.3g} m, exceeds the contacts' radius of {radius:g} m"
        return [f"{beyond}: Hertz's law requires indentations far below it"]


def _coordinates(model: Model, recorded: np.ndarray) -> dict[str, np.ndarray]:
    """Return the arrays of ``GIVEN``: numbers of ``recorded`` cells, masses, sites; properties of differing cells."""
    chain = model.chain
    given = {
        "cell": recorded + 1,
        "dof": np.arange(1, chain.cell.dofs + 1),
        "site": np.arange(1, len(chain.sites) + 1),
        "sites/cell": chain.sites.cells + 1,
        "sites/clearance": chain.sites.clearances,
    }
    if not has_equal_sides(chain.sites.gaps):
        given["sites/clearance"], given["sites/clearance_minus"] = chain.sites.gaps.T
    if chain.variation:
        given |= {f"lattice/{name}": array[recorded] for name, array in chain.variation.items()}
        given["spring"] = np.arange(1, len(chain.cell.springs) + 1)
    return given


def _places(points: list[PointTable]) -> dict[str, np.ndarray]:
    """Return the arrays of ``GIVEN`` that say where ``points`` are; none without points."""
    if not points:
        return {}
    return {
        "point": np.arange(1, len(points) + 1),
        "points/cell": np.array([point.cell for point in points]),
        "points/mass": np.array([point.mass for point in points]),
    }
