r"""Contacts: the contact force, the search for changes of contact, the landing of steps on them, the log of impacts.

A site is a pair of masses, host and resonator, with the relative displacement w = u_resonator - u_host and a
clearance D on both sides. ``law`` contains the compiled force, ``search`` the guaranteed root search and the landing on
a root, ``changes`` the changes of a site's mode within a step, ``tracker`` the modes and the log, ``together`` what
keeps stuck rigid sites closed that share masses.

**Law.** With the indentation x = sigma w - D on the side sigma = +1 or -1, the force on the host in contact is

    F = sigma kc x^n g,    g = 1 + c w'/w'_minus,    c = 3 (1 - r)/2,

n = 3/2 for Hertz's spheres (Johnson 1985, sec. 4.2) and n = 1 for a linear stop; w'_minus is the relative velocity
at the onset and r the restitution (Hunt and Crossley 1975). During approach w'/w'_minus > 0, so that the force is
larger on the way in than on the way out, and the contact dissipates the power

    P = sigma kc x^n (g - 1) w' = c kc x^n w'^2 / |w'_minus| >= 0.

For the reduced mass m, m w'' = -F gives w' dw'/(1 + c w'/w'_minus) = -kc x^n dx/m. Over a whole contact, from x = 0 to
x = 0, the right side integrates to zero, hence the rebound e = -w'_plus/w'_minus solves
e + log(1 - c e)/c = log(1 + c)/c - 1. Its expansion is e = r + O((1 - r)^2): r is the restitution of a nearly elastic
impact. The exact damping is the c that solves it for e = r. A fast separation makes g < 0, a pull; ``adhesion =
"clip"`` then takes g = 0: the contact dissipates the elastic energy that it has left. The error control of a step
resolves the kink there. A floor of |w'_minus| bounds g at a grazing onset.

**Modes.** A site is free, closed (in contact), unswitched or at rest in contact. Within a time step the modes
are frozen, and the law of a closed site is continued as an odd function through x = 0: the force is smooth, so that no
kink spoils the order of the method. Every change of mode is a switching function that crosses zero upwards:
sigma w - D (onset), D - sigma w (separation). A contact without loss that is
pressed at rest, or in which the masses of two cells touch, is unswitched: its force is that of max(x, 0) at all times,
kink included, and its mode never changes.

**Rest.** Motion within the tolerance of a landing is not resolved. The front of a wave grows from below it where a stop
has no clearance, and a mass may creep onto a stop, where impacts fade: both have many roots there, on each of which a
landing would be useless. A site therefore rests if it comes back to a stop without having left the tolerance, or if its
impact is too slow to leave it and its rebound too slow to go beyond a hundred tolerances. At rest its force is that of
max(x, 0), without loss, and nothing is landed on until it is a hundred tolerances away. There it becomes free or
closed. The approach velocity of a contact that begins
at an indentation x > 0 is the speed with which two masses alone come there from x = 0 without loss.

**Search.** w on a step of length h is the quintic Hermite interpolant of (w, w', w'') at both ends, in Bernstein
form: w(s h) = sum_i b_i B_i(s). The coefficients bound the polynomial. Its roots in the step are as many as the
changes of sign from one coefficient to the next, or fewer by an even number (Descartes' rule). No change of sign means
no root; one means exactly one root, which bisection finds. Otherwise de Casteljau's scheme halves the interval, and
the left half comes first: the first crossing is found even when a second one follows within the step (Lane and
Riesenfeld 1981).

**Landing.** The step is repeated so that it ends on the change: Newton's method on the switching function, evaluated
on the trajectory itself and not on the interpolant, as long as each iteration halves the distance; where one does not,
the search is repeated on the shorter step. It may find nothing there: the interpolant of the first step crossed zero
where the trajectory only came near. The step is then taken as it is.

References
----------
K. L. Johnson, Contact Mechanics, Cambridge University Press 1985, sec. 4.2 and 11.4.
K. H. Hunt and F. R. E. Crossley, Coefficient of restitution interpreted as damping in vibroimpact, J. Appl. Mech. 42
(1975) 440-445.
J. M. Lane and R. F. Riesenfeld, Bounds on a polynomial, BIT 21 (1981) 112-117.
"""
