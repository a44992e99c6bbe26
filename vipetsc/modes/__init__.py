"""Nonlinear normal modes of conservative systems with contacts: shooting, continuation, stability, branch files.

The pieces, as a loop of one's own uses them::

    corrector = Corrector(Shooting(Dop853Flow(system), MAPS["quarter"]))
    for point in Continuation(corrector, linear_start(corrector, mode, energy), StepControl()):
        ...

Importing the package loads PETSc.
"""

from vipetsc.modes.branch import Branch
from vipetsc.modes.continuation import Continuation, ContinuationError, Guards, StepControl
from vipetsc.modes.follow import follow_all
from vipetsc.modes.newmark import Newmark
from vipetsc.modes.orbit import Dop853Flow
from vipetsc.modes.point import Point, linear_start
from vipetsc.modes.shooting import MAPS, Corrector, Shooting
from vipetsc.modes.special import Locator, switch
from vipetsc.modes.system import ContactPair, SmoothSpring, System
from vipetsc.modes.tsrk import Tsrk

__all__ = [
    "MAPS",
    "Branch",
    "ContactPair",
    "Continuation",
    "ContinuationError",
    "Corrector",
    "Dop853Flow",
    "Guards",
    "Locator",
    "Newmark",
    "Point",
    "Shooting",
    "SmoothSpring",
    "StepControl",
    "System",
    "Tsrk",
    "follow_all",
    "linear_start",
    "switch",
]
