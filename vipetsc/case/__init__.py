"""Cases, which define simulations: strict TOML is read into a typed, immutable and fully resolved case.

``case_file`` turns a TOML file into a case, with all problems at once (``CaseFile`` is the base of every verb's case).
``schema`` holds the sections of a lattice run, ``resolve`` how their choices become numbers. Each verb has a module
with its case and the conditions between its keys: ``case`` that of ``run``, all others one of the verb's name;
``verb_cases`` lists them. The manual lists keys and units.
"""

from vipetsc.case.case import Case, Model, case_id
from vipetsc.case.case_file import CaseError, CaseFile, Problem
from vipetsc.case.design import DesignCase
from vipetsc.case.law import LawCase
from vipetsc.case.nnm import NnmCase
from vipetsc.case.sweep import Sweep, SweepMember
from vipetsc.case.verb_cases import VERB_CASES
