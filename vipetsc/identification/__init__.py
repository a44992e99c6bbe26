r"""Parameters of a lattice with contacts from measured motion.

**1. Motion and derivatives** (``motion``, ``misfit``). A record is compared with runs by the engines of ``run``, so
that everything that can be simulated can be identified. Derivatives by a parameter are central differences of two runs,
which ranks divide among them. They need no equations of their own, in which the derivative of a motion would bend at
every change of a contact (Leine and Nijmeijer 2004, ch. 7). The propagator makes this possible: its steps do not depend
on the parameters, and its motion follows them smoothly, to a tolerance of 1e-12.

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

A record that begins while the lattice moves has 2n more unknowns (``misfit``). They are amplitudes of modes,
with a wide prior about rest that the last fit keeps, since a few sensors may not determine all of them. The first
window has more data than unknowns.

**3. A clearance that is not reached** (``growing_windows``). The misfit does not depend on the clearance of a stop
that the model does not meet: no derivative leads to a contact that the model lacks, and none leads out of a contact
that the lattice did not have. Each clearance is therefore tried at some fractions of the motion without its stop,
within reach and just out of reach, and kept where that explains the record better. At the end, the largest motion
towards a stop that is not met is a lower bound of the clearance: a record without contact there says no more.

**4. Least squares** (``misfit``): the sum of squares of the residuals over the noise is minimised by the trust-region
method of SciPy within the bounds (Branch, Coleman and Li 1999), in the logarithms of positive parameters. Noise that is
not given is estimated from the residuals of each channel, and the fit is repeated with it: repeated until nothing
changes, this leads to the maximum of the likelihood.

**5. Uncertainty** (``uncertainty``). With the Jacobian J of the residuals over the noise, (J^T J)^-1 is
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
