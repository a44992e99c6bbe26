"""Continuation: one branch of solutions, step by step, with its special points and the branches that cross there.

A branch is a curve of solutions of n equations H(xi) = 0 in n + 1 unknowns. These are scaled to order one by a chart,
so that one arclength s suits all of them. From a point xi_0 with the unit tangent t, the null vector of dH/dxi, the
next one solves H(xi) = 0 and t . (xi - xi_0) = s by Newton's method of PETSc's SNES (Keller 1977, reference in
``modes``): ``arclength`` derives it and has the loop.

Narrow tongues of internal resonances lie close together. A point on another arc has as small a residual as one on the
branch, so that a residual does not show a jump. ``guards`` therefore bound the changes in one step: of asinh(c) of
each half-trace c = (mu + 1/mu)/2 of the Floquet multipliers mu, of the number of contacts, of the correction over the
step, and of the tangent's direction, in the step's chart and in that named ``relative``.

``segment`` is the branch between two neighbouring points, on which ``special`` locates special points. They are zeros
of test functions, by Brent's method: of dE along the tangent at energy folds, of dT at frequency folds, of
what half-traces show elsewhere. ``switching`` finds the first point of a branch that crosses at a special point.
"""

from vipetsc.modes.continuation.arclength import Continuation
from vipetsc.modes.continuation.segment import Segment
from vipetsc.modes.continuation.special import at_energy, locate
from vipetsc.modes.continuation.switching import switch
