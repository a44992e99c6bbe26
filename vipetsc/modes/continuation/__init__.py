"""Continuation: one branch of solutions, step by step, with its special points and the branches that cross there.

Keller (1977): from a point with unit tangent t in the unknowns xi of a chart (of order one, so that an arclength means
something) the next one solves H(xi) = 0 and t . (xi - xi0) = s, by Newton's method of PETSc's SNES. The tangent is the
null vector of dH/dxi.

Narrow tongues of internal resonances lie close together, and a residual cannot tell a jump from one arc to another.
``Guards`` therefore bound, per step, the change of asinh(c) of each half-trace, the number of contacts that appear or
go, the correction over the step and the turn of the tangent, in the step's chart and in ``relative``.

dE along the tangent vanishes at energy folds, dT at frequency folds; ``special`` locates them and what the half-traces
show, and switches branches; ``graze`` has a touch as two more equations.
"""

from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.continuation.segment import Segment
from vipetsc.modes.continuation.special import at_energy, locate
from vipetsc.modes.continuation.switching import switch
