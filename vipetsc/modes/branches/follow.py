"""Follow all branches of a case, distributed over ranks, into a folder that is claimed for them."""

from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from vipetsc.io.folder import BRANCHES, Claim, claimed, provenance
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.follower import BranchCase, Follower, Listener, method_of
from vipetsc.parallel import StopRequest


def claim_branches(
    case: BranchCase, folder: Path, comm: MPI.Comm, force: bool = False, resume: bool = False
) -> AbstractContextManager[Claim]:
    """Claim ``folder`` for the branches of ``case``, as ``claimed``.

    With ``resume`` the case may differ from the earlier one in where branches end, and in nothing of their physics.
    """

    def difference(earlier: str) -> str | None:
        # The whole case need not be the same: a branch that has used up its points is resumed with more of them.
        if type(case).from_toml(earlier).physics() == case.physics():
            return None
        return f"--resume needs {case.kept_by_resume}"

    text = case.to_toml()
    if not resume:
        return claimed(comm, folder, BRANCHES, text, force=force)
    return claimed(comm, folder, BRANCHES, text, force=force, resume=True, difference=difference)


def follow_all(
    case: BranchCase,
    folder: Path | None,
    comm: MPI.Comm,
    resume: bool = False,
    listener: Listener | None = None,
    stop: StopRequest | None = None,
) -> list[Branch[Any]]:
    """All branches of ``case``, written into ``folder`` if there is one.

    Each branch is computed on one rank, so that its bits do not depend on the number of ranks: rank r of n follows the
    branches r, r + n, r + 2n and so on. Where a lattice is shot without dense matrices, all ranks follow one branch
    together, and then the next one.

    A branch that fails is written as far as it came and says why in its ``ending``, and the others go on. Where the
    part below its start fails, the part above is followed all the same. A ``stop`` ends each branch at its next point,
    with an ending that begins with "stopped". With ``resume`` branches that were stopped go on to the same bits, and
    branches that failed, above their start or below it, are tried again from their last point. Returns all branches on
    rank 0, in the order of the case; an empty list on the others.
    """
    follower = partial(Follower, case, folder, provenance(comm), listener, stop, resume)
    jobs = method_of(case).jobs(case)
    # Collective calls inside: every rank follows the same branches in the same order.
    if method_of(case).shared:
        together = follower(comm)
        branches = [branch for job in jobs for branch in together.follow(job)]
        if comm.rank > 0:
            return []
        return branches

    # Neighbours in the list fall to different ranks; no rank waits for another until all are followed.
    followed: dict[int, list[Branch[Any]]] = {}
    numbers = range(comm.rank, len(jobs), comm.size)
    if numbers:
        alone = follower(comm=MPI.COMM_SELF)
        followed = {number: alone.follow(jobs[number]) for number in numbers}
    # ``gather`` returns None on the other ranks.
    by_number: dict[int, list[Branch[Any]]] = {}
    for of_rank in comm.gather(followed) or []:
        by_number |= of_rank
    return [branch for number in sorted(by_number) for branch in by_number[number]]
