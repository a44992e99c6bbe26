r"""Exact steps of the linear lattice, with the forces of contacts and drive collocated within them.

Between its contact sites the lattice is linear, M u'' = -K u + f(t), with u the displacements, M and K the matrices of
masses and springs, and f acts on few masses. In the step from t_0 to t_0 + H, with s = (t - t_0)/H in [0, 1], variation
of constants (Hochbruck and Ostermann 2010, sec. 2) gives the state

    y(t_0 + H) = P(H) y(t_0) + integral over the step of P(H - t + t_0) (0, M^-1 f(t)) dt,   y = (u, u').

**1. The propagator** (``series``, ``stencil``). P(H) takes a state through H of free motion, without f. With
A = H^2 M^-1 K, which contains the square of H, free motion is the series

    u(s) = sum_m (-A)^m [u_0 s^2m / (2m)! + H u'_0 s^(2m+1) / (2m+1)!].

Each power of K reaches one cell further, and its factor falls like 1/(2m)!: P is banded, but for entries so small that
they are left out. With theta = omega_max H, omega_max from Gershgorin's circles of M^-1/2 K M^-1/2, the terms from m on
are at most theta^(2m-1) (1 + theta)/(2m-1)! of the velocity's amplitude; ``reach`` r is the distance in cells beyond
which the rows of P sum to less than the tolerance. Both bounds and the entries dropped within the band make up
``truncation``. Since theta <= 3.2, no term exceeds the result by much, and the series is as good as rounding allows
(Moler and Van Loan 2003). Cells at least r from an end have one stencil in common; the others have rows of their own.

**2. Free motion of the contact DoFs** (``series``, ``dof_tables``). A DoF x = c u is a driven mass's displacement or
the relative displacement w of a site, of two masses in one cell or in neighbouring ones, or of a mass to ground: c has
an entry for each end, so that a force on w acts at both. Its rows c (-A)^m give its free motion x(s) = sum_k a_k s^k
beforehand: a site with sum |a_k| < D cannot touch. Otherwise |w''| <= B = sum k (k - 1) |a_k| bounds w by a parabola:
on the side sigma one may go from s by the d with D - sigma w - sigma w' d - B d^2/2 = 0 without passing an onset, and
such steps converge to the first one.

**3. Forces** (``collocation``, ``nodes``). An impulse on DoF l moves DoF i by G_il(s) = sum_m g_ilm s^(2m+1), odd
coefficients as in 1. While forces act,

    x_i(s) = a_i(s) + H sum_l integral_0^s G_il(s - z) F_l(z, x_l, x'_l) dz,

a Volterra equation. In substeps of length h it is collocated at eight Gauss nodes (Hairer, Norsett and Wanner 1993,
sec. II.7): F is its interpolant through the nodes, the integrals of s^k times Lagrange's polynomials are tables, and
Picard's iteration solves for the values at the nodes (reasons in ``collocation``). With Hertz's law F begins and ends
as the power 3/2 of time; in the root of the time since the onset, s = h z^2, or before the separation, s = h z (2 - z),
it is smooth (Brunner 2004, sec. 6.2), and the nodes are Gauss's in z. The last two Legendre coefficients of F at the
nodes estimate the error, by which h is controlled. After the substep the a_i are shifted to its end, and the motion
caused by F is added to them.

**4. Changes** (``advance``). Substeps are searched for changes of a site's mode on the quintic Hermite interpolant of w
and repeated so that they end on the first one: see ``vipetsc.contact``. Contacts that touch or are pressed at rest act
always, F being what they have beyond their load. They change no mode, but F has a kink where they open or close, and
substeps end there, too.

At a rigid stop an impulse J adds G_il(s - s_J) J to x_i, as a force in a time dt adds G_il F dt. A site that sticks has
w'' = 0, by which its reaction follows: R/mu = -a'' - integral of G'' R, an equation of the second kind.

**5. What forces leave in the lattice** (``dof_tables``). K and M are symmetric, and so is (-A)^m M^-1: the motion
after an impulse on a DoF, (-A)^m M^-1 c^T = M^-1 (c (-A)^m)^T, has the rows of 2 again (Maxwell's reciprocity). With
the moments mu_k = integral of F (1 - s)^k dt over the step,

    u += M^-1 sum_m (c (-A)^m)^T H mu_(2m+1) / (2m+1)!,   u' += M^-1 sum_m (c (-A)^m)^T mu_2m / (2m)!

in the cells within r. Nothing else of the forces' history is needed.

**6. Clusters and ranks** (``dof_tables``, ``stencil``). DoFs within r cells of one another, counted from any cell that
they have a mass in, must be solved for together: they are a group, and on a rank that feels it a cluster. Every rank
that owns a cell within r of a cluster advances it, from the same numbers to the same bits, so that ranks communicate
only by one exchange of ``HaloRegions`` per step. ``engine`` weighs a step's cost against the size of its
clusters. Its loop over a block of samples is compiled as a whole: ranks agree on requests and failures at a block's
end, to which a rank that cannot follow its contacts goes on without them. After a failure all go back to a state that
they have saved, and from there to the first step that failed: a run ends in the same way on any number of ranks.

**7. Dashpots** have the matrix C. With M u'' = -K u - C u' + f free motion has all powers of s, each with a matrix P_k
for displacements and Q_k for velocities: with P_0 = 1, Q_0 = 0 (``rows``)

    u(s) = sum_k s^k/k! (P_k u_0 + Q_k H u'_0),   P_(k+1) = -Q_k H^2 M^-1 K,   Q_(k+1) = P_k - Q_k H M^-1 C.

In the norm of the energy the state turns by no more than [gamma + (gamma^2 + 4 omega_max^2)^1/2]/2, gamma from
Gershgorin's circles of M^-1/2 C M^-1/2: H times that is theta in the bounds of 1. M p^2 + C p + K is symmetric, so is
its inverse, and Q_k M^-1: in 3 and 5, where G has all powers, M^-1 (c Q_k)^T is the motion after an impulse.

**8. Cells that differ** have separate rows, with the masses, springs and dashpots of the cells up to r + 1 away. Cells
beyond could only act by waves that travel there and back, which counts as entries left out once more. Cells with equal
neighbourhoods share their rows. omega_max and gamma are the largest of all cells; r and the truncation are those of a
lattice each of whose entries of K M^-1 and C M^-1 has the largest magnitude that any cell's has.

**9. What dashpots dissipate** is not computed from the motion: ``energies`` takes it from the balance, as the work
less what contacts have dissipated and less the energy of the lattice. ``observers.Ledger`` checks that it never falls,
and compares it with a quadrature over the samples.

**10. Nonlinear springs** (``groups``, ``collocation``) have the force k z + k_2 z^2 + k_3 z^3 at their
elongation z, of which k belongs to K. The rest is a force on the DoF z = c u, with c as for the w of a site,

    F = -(k_2 z^2 + k_3 z^3),

at all times and smooth: 3 and 5 hold, with Gauss's nodes in time. Where the bound sum |a_k| on z of 2 makes F smaller
than the rounding of k z, no force acts. The samples' energies have F's potential k_2 z^3/3 + k_3 z^4/4; what F does
comes back, and is booked nowhere. The cost of such springs grows with their number, that of ``ts`` with the number of
masses: ``step_choice`` compares the two.

**Modules**, from the lattice to the engine. ``rows``: powers of the lattice's matrix, row by row. ``series``: how many
of them count, and how far. ``groups``: contact DoFs and their groups. ``step_choice``: the length of a step.
``taylor``: values of the series. ``stencil``: P on a rank's cells. ``dof_tables``: tables of contact DoFs. ``nodes``:
tables of the collocation. ``substeps``: records of a cluster and of a substep. ``collocation``: one substep.
``advance``: substeps up to a change of modes. ``clusters``: changes up to the step's end. ``engine``: steps up to the
sample.

References
----------
H. Brunner, Collocation Methods for Volterra Integral and Related Functional Differential Equations, Cambridge 2004.
E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., Springer 1993.
M. Hochbruck and A. Ostermann, Exponential integrators, Acta Numerica 19 (2010) 209-286.
C. Moler and C. Van Loan, Nineteen dubious ways to compute the exponential of a matrix, SIAM Review 45 (2003) 3-49.
"""
