"""Continuation of branches: ``arclength`` begins with its equations, and ``switching`` leads to branches that cross.

A branch is a curve of solutions of n equations H(xi) = 0 in n + 1 unknowns, periodic motions by any method.
"""

from vipetsc.modes.continuation.arclength import Continuation, Segment, at_energy, locate
from vipetsc.modes.continuation.switching import switch
