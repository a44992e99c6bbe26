"""What belongs to the verb ``optimise`` alone.

``case`` has its case and section; ``variables`` what a search may vary, ``search_space`` their values and the cases
that have them, ``problems`` what is wrong with variables; ``objective`` has objectives and constraints.
"""

from vipetsc.case.optimise.case import OptimiseCase
from vipetsc.case.optimise.objective import MeasuredTable, ObjectiveTable, measures_of_runs
from vipetsc.case.optimise.search_space import SearchSpace
from vipetsc.case.optimise.variables import Variable
