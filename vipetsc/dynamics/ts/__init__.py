r"""Runge-Kutta time stepping of the lattice by PETSc's TSRK, with a landing on every contact change.

**Equations.** With u the displacements (cell, mass), k_s the springs, F_i the contact force of site i and f the burst,

    m_a u''_a = sum_s k_s (u_b - u_a) +- F_i + f,    W' = f u'_d,    E_i' = P_i,

so that the work W of the drive at mass d and the dissipated energies E_i are integrated with the trajectory, by the
same method. ``right_hand_side`` evaluates this as a first-order system; PETSc calls it as a C function.

**Step length.** The embedded pair's error is controlled in the maximum norm with the tolerances rtol |u| + atol, whose
atol differs for displacements and velocities. W and E_i carry an absolute tolerance so large that they never decide
the step. The result depends neither on the length of the lattice nor on its partition: all sums over a cell run in the
order of its springs, and the maximum and all reductions are exact.

**Steps and events** (``integrator``). PETSc 3.18's own event handling loses short contacts and switches the error
control off where they occur, hence:

- the modes of all sites are frozen inside a step, so that the right-hand side is smooth in it;
- after each accepted step every site is searched for a change (see ``vipetsc.contact``), and one reduction finds the
  earliest over all ranks; the state returns to a saved copy and the step is repeated so that it ends on the change,
  to |w - D| <= 1e-10 D, where modes switch;
- contacts that touch or are pressed at rest keep their mode and have a kink where they open or close: steps end there,
  too, to 1e-8 of their scale: the impulse of what is left of the kink goes with the square of that;
- a rejected trial also returns to the saved copy: PETSc rolls back by subtraction, which loses digits where the trial
  was far too long for a contact;
- TSRK restarts after every change, so that a first-same-as-last pair does not reuse a stage of the old modes, and at
  every sample, where a run may have gone on from a checkpoint;
- after an onset the step is a small fraction of the contact's duration (Johnson 1985, sec. 11.4), since Hertz's force
  begins like (t - onset)^(3/2), which no method of high order resolves. PETSc takes this step in z, with
  t = onset + z^2/h and 0 <= z <= h (Brunner 2004, sec. 6.2): in z the force is smooth. Without that, this one step had
  nine tenths of a contact's error in energy. Before a separation the force is as singular; there the error that is left
  is a few times smaller, and no end is known beforehand that a step could go to.

The default pair is Verner's 8(7), ``8vr``.

References
----------
H. Brunner, Collocation Methods for Volterra Integral and Related Functional Differential Equations, Cambridge 2004.
E. Hairer, S. P. Norsett and G. Wanner, Solving Ordinary Differential Equations I, Springer 1993, sec. II.4 and II.6.
J. H. Verner, Numerically optimal Runge-Kutta pairs with interpolants, Numer. Algorithms 53 (2010) 383-396.
L. F. Shampine and S. Thompson, Event location for ordinary differential equations, Comput. Math. Appl. 39 (2000) 43-54.
S. Abhyankar et al., PETSc/TS: a modern scalable ODE/DAE solver library, arXiv:1806.01437.
"""
