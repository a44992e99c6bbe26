"""The frame of every study with one result file: its folder is claimed, computed, written, published and read.

A study brings how its runs are computed and how its result is read (``Study``). Runs are recorded as they end. The
result is written last, so that a folder with its result is complete, and a kill before that leaves the records, from
which the next call continues. A result that was cut off, on a full disk for instance, is computed again from them.
"""

import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypedDict, TypeVar

from mpi4py import MPI

import h5py
import xarray as xr

from vipetsc.io.folder import claimed
from vipetsc.io.kinds import ResultKind
from vipetsc.io.netcdf import write_netcdf
from vipetsc.parallel import StopRequest, on_root

logger = logging.getLogger(__name__)
Result = TypeVar("Result")


class How(TypedDict, total=False):
    """How a study uses its folder and is watched; every study takes these keywords.

    ``force`` starts again, and replaces the results in the folder when the new ones are complete; ``resume`` requires
    earlier results. ``stop`` is a request to stop, after which the next call continues, to the same bits on any number
    of ranks. With ``progress`` bars on rank 0 show what is done.
    """

    force: bool
    resume: bool
    stop: StopRequest | None
    progress: bool


class StudyWork(NamedTuple):
    """Where a study computes: the ``folder``, the ranks ``comm``, the request to ``stop``, whether it shows bars."""

    folder: Path
    comm: MPI.Comm
    stop: StopRequest
    progress: bool


@dataclass(frozen=True)
class Study(Generic[Result]):
    """A study, whose results are of a ``kind``, in the ``file`` of the folder.

    ``make`` computes the runs of a case on all ranks, and merges their records. It returns a function that gives the
    content of the file: rank 0 calls it, and writes the file. ``read`` reads the result from a folder.
    """

    kind: ResultKind
    file: str
    make: Callable[[Any, StudyWork], Callable[[], xr.Dataset]]
    read: Callable[[Path], Result]

    def run(
        self,
        case: Any,
        folder: str | Path,
        comm: MPI.Comm,
        *,
        force: bool = False,
        resume: bool = False,
        stop: StopRequest | None = None,
        progress: bool = False,
    ) -> Result:
        """Compute the study of ``case`` in ``folder`` on all ranks of ``comm``; returns its result, on all ranks.

        Raises FolderError if the folder cannot be used as asked, StoppedError on a request to ``stop``, StudyError if a
        run fails without which there is no result.
        """
        with claimed(comm, folder, self.kind, case.to_toml(), force=force, resume=resume) as claim:
            path = claim.folder / self.file
            # Rank 0 looks for all ranks: one that saw no file would begin the runs alone.
            if not on_root(comm, lambda: _is_there(path)):
                work = StudyWork(claim.folder, comm, stop or StopRequest(), progress)
                compose = self.make(case, work)
                sys.audit("vipetsc.conclude", str(claim.folder))
                # Seconds, in which nobody looks at requests to stop; the runs are recorded.
                with work.stop.at_once():
                    on_root(comm, lambda: write_netcdf(path, compose()))

            claim.publish()
            return on_root(comm, lambda: self.read(claim.folder))


def _is_there(path: Path) -> bool:
    """Return whether a result is there; warns of one that is computed again."""
    lost: list[str] = []
    whole = is_whole(path, lost)
    for sentence in lost:
        logger.warning("vipetsc: warning: %s", sentence)
    return whole


def is_whole(path: Path, lost: list[str]) -> bool:
    """Return whether an HDF5 file is there and can be opened; if it is there and cannot, ``lost`` gets a sentence.

    HDF5 does not open a file that is shorter than it says itself.
    """
    try:
        h5py.File(path).close()
    except OSError as error:
        # A link that leads nowhere is there, too.
        if os.path.lexists(path):
            lost.append(f"{path} cannot be read: {error}; computed again")
        return False
    return True
