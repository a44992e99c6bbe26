"""Cases, which define simulations: strict TOML is read into a typed, immutable and fully resolved case.

``reading`` turns a TOML file into sections, with all problems at once; ``CaseFile`` is the base of every verb's case.
``schema`` holds the sections of a lattice run, ``resolve`` how their choices become numbers. Each verb has a module or
a folder with its case and the conditions between its keys: ``case`` that of ``run``, all others one of the verb's name;
``verb_cases`` lists them. The manual lists keys and units.

A case file passes these stages, each of which reports all of its problems at once:

1. ``read_toml``: the text is TOML; ``--set`` changes it (``with_overrides``).
2. ``CaseFile.fields_of``: the sections exist, the modules of ``[plugins]`` can be imported (``parts``).
3. ``read_section``: each key has a type and bounds that its field states (pydantic), and a magnitude that products of a
   few numbers can bear.
4. ``check`` of the verb's case: conditions between keys; what the verb does not accept (``refuses``, ``features``).
5. ``resolve``: every choice becomes a number; problems of numbers that follow, as of an absorbing end or of samples.
6. ``with_drawn``: scatter is drawn about the resolved values, and the case is checked again.

What depends on the machine, as memory and PETSc's options, is asked by ``dynamics`` when a run begins.
"""

from vipetsc.case.case import Case, Model, case_id
from vipetsc.case.case_file import CaseFile
from vipetsc.case.design import DesignCase
from vipetsc.case.law import LawCase
from vipetsc.case.nnm import NnmCase
from vipetsc.case.section import CaseError, Problem
from vipetsc.case.sweep import Sweep, SweepMember
from vipetsc.case.verb_cases import VERB_CASES
