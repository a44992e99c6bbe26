r"""Parameters of a lattice with contacts from measured motion.

**1. Motion and derivatives** (``motion``, ``motion_rates``, ``motion_steps``). The displacements u solve the equations
of motion with the masses M, the dashpots C and the linear springs K. At a site c the relative displacement is w = c u
and the contact force F_c; a spring d has the elongation z = d u, and N_d is the nonlinear part of its force:

    M u'' + C u' + K u + sum_d d^T N_d(z) + sum_c c^T F_c(w, w', w'_minus) = f(t),    (u, u')(t_0) = x_0.

The derivative s = du/dp with respect to a parameter p solves the variational equation

    M s'' + C s' + K s + sum_d d^T [N_z d s + N_p] + sum_c c^T [F_w c s + F_v c s' + F_q dq + F_p]
        = f_p - M_p u'' - C_p u' - K_p u,

where an index is a partial derivative, v = w', and q = w'_minus, the relative velocity at the last onset, whose
derivative is dq. Contact forces are continuous where a contact changes its mode, and steps end there: s does not jump
(the saltation of the state is the identity, Leine and Nijmeijer 2004, ch. 7). An onset is at w = sigma D, where D is
the clearance and sigma is +1 or -1, the side. For a change of p by 1 its instant moves by -(c s - sigma D_p)/w', so
that

    dq = c s' - w'' (c s - sigma D_p)/w'.

At t_0 the derivative s is that of x_0 (``motion_begin``): zero for a lattice at rest. Motion and derivatives are
integrated together.

The derivatives of the coefficients are differences between models of two cases, so that a parameter needs no formula of
its own. Central differences are exact to about 1e-10: most coefficients are affine in a parameter, the others smooth.
Where a parameter is at a bound the difference is one-sided: its error is 5e-6 of the second derivative of those
coefficients that are not affine.

The tangent flow of the engine, ``dynamics.propagator.tangent``, moves variations of the initial state of an undriven
lattice; it has no right-hand side f_p - K_p u, which acts in all cells. Motion and derivatives therefore have an
integration of their own here, which tests compare with central differences of both engines.

**2. Windows** (``growing_windows``). A motion after many impacts is so sensitive to the parameters that the sum of
squares over a long record has many valleys; only from within the deepest one does a fit end in it. In multiple shooting
(Bock 1987) the record is cut into windows, each of which has an initial state of its own, estimated with the
parameters, and continuity is a constraint. A lattice of n masses has 2n unknowns in each such state, and a few sensors
in a short window do not determine them. Here all windows begin with the record and have the one initial state of it. A
lattice that begins at rest, or in a motion that the case gives, has no unknown state at all.

The first window ends after a few contacts. Each next one has more contacts, but so few more that their instants in the
model are nearly right: the fit begins in the right valley. Where a longer window is fitted worse, fewer contacts are
added. A weak prior holds the parameters that a window does not determine near their last values; the fit over the whole
record has none.

A record that begins while the lattice moves has 2n more unknowns (``initial_state``). They are amplitudes of modes,
with a wide prior about rest that the last fit keeps, since a few sensors may not determine all of them. The first
window has more data than unknowns.

**3. A clearance that is not reached** (``clearance_search``). The misfit does not depend on the clearance of a stop
that the model does not meet: no derivative leads to a contact that the model lacks, and none leads out of a contact
that the lattice did not have. Each clearance is therefore tried at some fractions of the motion without its stop,
within reach and just out of reach, and kept where that explains the record better. At the end, the largest motion
towards a stop that is not met is a lower bound of the clearance: a record without contact there says no more.

**4. Least squares** (``misfit``): the sum of squares of the residuals over the noise is minimised by the trust-region
method of SciPy within the bounds (Branch, Coleman and Li 1999), in the logarithms of positive parameters. Noise that is
not given is estimated from the residuals of each channel, and the fit is repeated with it: repeated until nothing
changes, this leads to the maximum of the likelihood.

**5. Uncertainty** (``uncertainty``, ``whiteness``). With the Jacobian J of the residuals over the noise, (J^T J)^-1 is
the covariance of all coordinates. Its block for the parameters is their covariance with the initial states left free.
The singular values s of J are 1 over the standard errors along its right singular vectors. An error of more than half a
unit of a coordinate, a factor of 1.6, counts as not determined. A profile (``misfit_profile``) holds one parameter at
several values and fits all others: it shows where an interval is no multiple of the standard error. Residuals that are
not white (Ljung and Box 1978) show that the model is incomplete.

References
----------
H. G. Bock, Randwertproblemmethoden zur Parameteridentifizierung in Systemen nichtlinearer Differentialgleichungen,
Bonner Mathematische Schriften 183 (1987).
M. A. Branch, T. F. Coleman and Y. Li, SIAM J. Sci. Comput. 21 (1999) 1-23.
R. I. Leine and H. Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, Springer 2004.
G. M. Ljung and G. E. P. Box, On a measure of lack of fit in time series models, Biometrika 65 (1978) 297-303.
"""
