r"""Nonlinear normal modes of conservative systems with contacts: their branches, stability and special points.

The system is M u'' + K u + f(u) = 0 with masses in contact pairs and smooth springs (``system``); a nonlinear normal
mode is a family of periodic orbits that begins at a linear mode (Kerschen et al. 2009; Rosenberg's in the odd case).

**Shooting.** ``flow`` gives the flow phi_t of an initial state and its derivative S = d phi_t/d y0; ``shooting`` asks
for initial values x and the period T. The flow is reversible, t -> -t with v -> -v, so that an orbit that is at rest
(v = 0) twice, at 0 and T/2, is periodic: half a period is enough, with the n unknowns u(0) and the n equations
v(T/2; u0, 0) = 0. If f is odd the orbit u(t + T/2) = -u(t) passes the centre u = 0 at T/4: a quarter is enough,

    H(x, T) = u(T/4; x, 0) = 0,    dH/dx = A,    dH/dT = v(T/4)/4,    S = [[A, B], [C, D]].

The whole period is there for comparison: its condition is 1e6 times worse. n equations for n + 1 unknowns: a branch.

**Variational equations.** S' = [[0, I], [-M^-1 (K + f'(u)), 0]] S is integrated beside the orbit (``flow``; ``dop853``:
Dormand and Prince's pair, Hairer et al. 1993; ``reference``: PETSc's, Newmark's rule). At a contact change
h(u) = |w| - D = 0 the slope f' jumps, and S passes it with the saltation matrix (Leine and Nijmeijer 2004, ch. 7)

    S+ = (I + (g+ - g-) grad h^T / (grad h^T g-)) S-,

g-/+ being y' before and after it. Contact forces are continuous, g+ = g-: the saltation is the identity if the step
ends exactly on the change and each step uses one f'. ``changes`` searches each step for its first change.

**Stability.** In mass-normalised coordinates S is symplectic, and the arc's mirror image needs no integration: from
rest to rest in T/2 the monodromy matrix R S^-1 R S, R = diag(I, -I), has the diagonal block I + 2 B^T C, whose
eigenvalues are the half-traces c = (mu + 1/mu)/2 of the multipliers. For a quarter the map over T/2 with the sign
reversed has I - 2 D^T A, and its multipliers are squared. One c = 1 is trivial: energy is conserved. c in (-1, 1) is
stable; c = 1 is a fold of the energy or a branch point; c = -1 breaks the symmetry (quarter) or doubles the period
(others); c = 0 doubles the period of a quarter's orbit (``special`` locates them by arclength and switches branches).
dE along the tangent vanishes at energy folds, dT at frequency folds; ``graze`` has a touch as two more equations.

**Continuation.** Keller (1977): from a point with unit tangent t in the unknowns xi of a chart (of order one, so that
an arclength means something) the next one solves H(xi) = 0 and t . (xi - xi0) = s, by Newton's method of PETSc's
SNES. The tangent is the null vector of dH/dxi. Charts scale: ``relative`` (gaps over the clearance), ``logarithmic``,
``grazing`` (a root of w - D in place of w: an orbit that starts on its largest |w| depends on w - D through one).
Narrow tongues of internal resonances lie close together, and a residual cannot tell a jump from one arc to another.
``Guards`` therefore bound, per step, the change of asinh(c) of each half-trace, the number of contacts that appear or
go, the correction over the step and the turn of the tangent, in the step's chart and in ``relative``; ``branch_checks``
looks for jumps afterwards, for a branch that retraces itself, stands still or passes on to another one, and compares
flows.

**Condensed.** ``condensed`` has the equations of a motion's harmonics where the system is nonlinear, ``harmonics`` the
forces in them, ``breather`` the start and the continuation, ``condensed_follow`` the files.

**Files.** ``follow`` shares the branches of a case over ranks; ``branch`` writes and reads them, tells the regions of
a backbone and fits their power laws; ``point`` is one orbit, with its samples and its resonance. Lattices on
all ranks: ``lattice_flow``, ``lattice_shooting``, ``lattice_follow``, ``floquet`` (multipliers, matrix-free).

A loop of one's own (importing the package loads PETSc)::

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
from vipetsc.modes.branch import Branch
from vipetsc.modes.continuation import Continuation, ContinuationError
from vipetsc.modes.dop853 import Dop853Flow
from vipetsc.modes.follow import follow_all
from vipetsc.modes.point import Point, linear_start
from vipetsc.modes.reference import Newmark, Tsrk
from vipetsc.modes.shooting import MAPS, Shooting
from vipetsc.modes.special import locate, switch
from vipetsc.modes.system import ContactPair, SmoothSpring, System
