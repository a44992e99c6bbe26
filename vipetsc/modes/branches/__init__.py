"""Branches of a case: followed one a rank, checked, and written to files that resume them.

``branch`` is a branch in memory, ``files`` its file; ``regions`` are those of a backbone, with their power laws.
``branch_checks`` looks for a branch that retraces itself, stands still or passes on to another one; ``follow``
continues branches and distributes those of a case over ranks.
"""

from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import read_branch, write_branch
from vipetsc.modes.branches.follow import Follower, claim_branches, follow_all
