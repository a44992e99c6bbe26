r"""Nonlinear normal modes of conservative systems with contacts: their branches, stability and special points.

The system is M u'' + K u + f(u) = 0 with masses in contact pairs and smooth springs (``system``); a nonlinear normal
mode is a family of periodic orbits that begins at a linear mode (Kerschen et al. 2009; Rosenberg's in the odd case).

**Modules.** ``problem`` is the interface between continuation and a method; ``system`` is the system, ``stops`` a
contact of it, ``point`` an orbit of a branch, ``newton`` Newton's method for n equations in n + 1 unknowns.
``shooting`` finds periodic orbits by integrating them with ``flow``, ``stability`` has their multipliers. Each of these
begins with its equations.

**Subpackages**, whose docstrings derive the methods. ``balance`` finds periodic motions by their harmonics;
``continuation`` follows branches of either method, ``branches`` follows and stores the branches of a case. ``response``
has steady responses to a drive, which are not modes but are found by the same equations and the same continuation.

A user-written loop (importing the package loads PETSc)::

    problem = Shooting(Dop853Flow(system), MAPS["quarter"])
    for point in Continuation(problem, linear_start(problem, mode, energy), NnmTable()):
        ...

References
----------
G. Kerschen, M. Peeters, J. C. Golinval, A. F. Vakakis, Nonlinear normal modes, part I, and M. Peeters et al., part II,
Mech. Syst. Signal Process. 23 (2009) 170-194 and 195-216.
H. B. Keller, Numerical solution of bifurcation and nonlinear eigenvalue problems, in: Applications of Bifurcation
Theory, ed. P. H. Rabinowitz, Academic Press 1977, 359-384.
R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, Springer 2004.
J. R. Dormand and P. J. Prince, A family of embedded Runge-Kutta formulae, J. Comput. Appl. Math. 6 (1980) 19-26.
E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., Springer 1993.
"""

from vipetsc.case.nnm import Guards, NnmTable
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.files import read_branch, write_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.continuation.arclength import Continuation, locate
from vipetsc.modes.continuation.switching import switch
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import ContactPair, SmoothSpring, System
