"""What to simulate: strict TOML in, a typed, frozen and fully resolved case out.

``reading`` turns a TOML file into a case, with all problems at once (``CaseFile`` is the base of every verb's case);
``schema`` holds the sections of a lattice run, ``checks`` what must hold between their keys, ``resolve`` how choices
become numbers; ``case``, ``sweep``, ``nnm`` and ``design`` are the cases of the verbs. Keys and units: the manual.
"""

from vipetsc.case.case import Case, Model, case_id
from vipetsc.case.design import DesignCase
from vipetsc.case.nnm import NnmCase
from vipetsc.case.reading import CaseError, CaseFile, Problem
from vipetsc.case.sweep import Sweep, SweepMember
