"""Systems that many tests share: the paper's contact and reduced model, and the benchmark of Kerschen and Peeters."""

from __future__ import annotations

import numpy as np

from vipetsc.lattice import Contact, contact_stiffness, four_band
from vipetsc.modes.stops import Stops
from vipetsc.modes.system import SmoothSpring, System

# The clearance of the paper's reduced model (Sec. IV), and the radius and Poisson's ratio of the contacts (Sec. III).
CLEARANCE = 10**-2.75
RADIUS = 0.005
POISSON = 0.3

IN_PHASE = 0
OUT_OF_PHASE = 1

# Energies in J at which the linear modes of the reduced model touch the stops: omega^2 (D/w)^2/2, with the clearance D
# and the relative displacement w in the mode of unit modal mass.
GRAZING_ENERGY = {OUT_OF_PHASE: 0.0293434562302, IN_PHASE: 0.0035442314356}


def four_band_contact(law: str = "hertz", modulus: float = 1e8, exponent: float | None = None) -> Contact:
    """The conservative contact of the four-band lattice; its ``modulus`` is 100 MPa in the paper."""
    return Contact(law, contact_stiffness(modulus, RADIUS, POISSON), exponent=exponent)


def force_of(
    law: Contact, w: np.ndarray, clearance: float, rate: float | np.ndarray = 0.0, approach: float = np.inf
) -> np.ndarray:
    """Return the force in N on the host at ``w`` (...) in m, with stops of a ``law`` on both sides."""
    elastic = law.elastic_force(w - clearance) - law.elastic_force(-w - clearance)
    return elastic * law.dissipation_factor(rate, approach)


def reduced_model(law: str = "bilinear", modulus: float = 1e8, exponent: float | None = None) -> System:
    """The paper's two masses with one contact between them (Sec. IV)."""
    return System.reduced(four_band(), Stops.both(four_band_contact(law, modulus, exponent), CLEARANCE))


def kerschen_system() -> System:
    """x1'' + 2 x1 - x2 + x1^3/2 = 0, x2'' + 2 x2 - x1 = 0: the benchmark of Kerschen and Peeters (2009)."""
    springs = [(None, 0, 1.0), (0, 1, 1.0), (None, 1, 1.0)]
    return System.assemble([1.0, 1.0], springs, smooth=[SmoothSpring.between(None, 0, cubic=0.5)])


# The system of ``kerschen_system`` as the table [nnm.own]. A step along its branches takes milliseconds.
KERSCHEN = {
    "masses": [1.0, 1.0],
    "springs": [
        {"start": 0, "end": 1, "stiffness": 1.0},
        {"start": 1, "end": 2, "stiffness": 1.0},
        {"start": 0, "end": 2, "stiffness": 1.0},
    ],
    "smooth": [{"start": 0, "end": 1, "cubic": 0.5}],
}
# Two masses, of which the first one is joined to the first one of the next cell; a lattice of them is symmetric under
# reflection.
TWO_MASS_CELL = {
    "masses": [4e-3, 2e-3],
    "springs": [{"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 5e3}],
}
# A cell that no preset has: three masses in a row, of which the first one is joined to the first one of the next cell.
THREE_MASS_CELL = {
    "masses": [0.010, 0.004, 0.002],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 6e3},
        {"start": 2, "end": 3, "stiffness": 1e3},
    ],
    "contact": [2, 3],
}
