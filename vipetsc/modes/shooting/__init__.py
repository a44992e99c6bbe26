"""Shooting: periodic orbits as boundary value problems over a part of their period.

``flow`` gives the flow phi_t of an initial state and its derivative S = d phi_t/d y0; ``shooting`` asks for initial
values x and the period T. The flow is reversible, t -> -t with v -> -v, so that an orbit that is at rest (v = 0)
twice, at 0 and T/2, is periodic: half a period is enough, with the n unknowns u(0) and the n equations
v(T/2; u0, 0) = 0. If f is odd the orbit u(t + T/2) = -u(t) passes the centre u = 0 at T/4: a quarter is enough,

    H(x, T) = u(T/4; x, 0) = 0,    dH/dx = A,    dH/dT = v(T/4)/4,    S = [[A, B], [C, D]].

The n equations for n + 1 unknowns leave a curve of solutions, the branch. The whole period may be shot as well, for
comparison, but its equations are worse conditioned (``maps``).

**Variational equations.** S' = [[0, I], [-M^-1 (K + f'(u)), 0]] S is integrated together with the orbit (``flow``;
``dop853``: Dormand and Prince's pair, Hairer et al. 1993). At a contact change h(u) = |w| - D = 0 the slope f' jumps,
and S passes it with the saltation matrix (Leine and Nijmeijer 2004, ch. 7)

    S+ = (I + (g+ - g-) grad h^T / (grad h^T g-)) S-,

g-/+ being y' before and after it. Contact forces are continuous, g+ = g-: the saltation is the identity if the step
ends exactly on the change and each step uses one f'. ``landing`` searches each step for its first change.

``arc_limits`` bounds the steps of an arc in an attempt of Newton's method.

**Stability.** In mass-normalised coordinates S is symplectic, and the arc's mirror image needs no integration: from
rest to rest in T/2 the monodromy matrix R S^-1 R S, R = diag(I, -I), has the diagonal block I + 2 B^T C, whose
eigenvalues are the half-traces c = (mu + 1/mu)/2 of the multipliers. For a quarter the map over T/2 with the sign
reversed has I - 2 D^T A, and its multipliers are squared. One c = 1 is trivial: energy is conserved. c in (-1, 1) is
stable; c = 1 is a fold of the energy or a branch point; c = -1 breaks the symmetry (quarter) or doubles the period
(others); c = 0 doubles the period of a quarter's orbit.

**Charts** scale the unknowns: ``relative`` (gaps over the clearance), ``grazing`` (a root of w - D in
place of w: an orbit that starts on its largest |w| depends on w - D through one).
"""

from vipetsc.modes.shooting.charts import Chart, Grazing, Relative
from vipetsc.modes.shooting.dop853 import Dop853Flow
from vipetsc.modes.shooting.flow import Arc, Flow
from vipetsc.modes.shooting.maps import MAPS, ShootingMap
from vipetsc.modes.shooting.orbit import repetitions, sample_orbit
from vipetsc.modes.shooting.shooting import Shooting
from vipetsc.modes.shooting.start import linear_start
