"""The stops of a contact: its law, and where it acts on both sides of the state at rest.

With the elastic law f(x), which vanishes for x <= 0, the force at the relative displacement w is

    f(w - plus) - f(-w - minus) - load,    load = f(-plus) - f(-minus),

so that it vanishes at rest. The load is zero unless a clearance is negative: the contact is then pressed at rest.
"""

from typing import NamedTuple, Self

from vipetsc.lattice import Contact


class Stops(NamedTuple):
    """The ``law`` of a contact, and where its stops are: clearances in m on the sides ``plus`` and ``minus``.

    A clearance of inf means that there is no stop on that side. A negative one is the depth by which the contact is
    pressed at rest, where a static load balances its force. The other fields serve harmonic balance. ``weight`` is a
    factor of the force, and ``drag`` in N s/m a dashpot parallel to it, by which a steady state in contact is reached
    step by step (``response.steps``). ``spring`` in N/m is the stiffness by which the linear system represents a
    pressed contact, and which is therefore taken off its force. The methods ``force`` and ``energy`` are those of the
    contact alone, with the weight 1.
    """

    law: Contact
    plus: float
    minus: float
    weight: float = 1.0
    drag: float = 0.0
    spring: float = 0.0

    @classmethod
    def both(cls, law: Contact, clearance: float) -> Self:
        """Return stops at the same ``clearance`` in m on both sides."""
        return cls(law, clearance, clearance)

    @property
    def clearance(self) -> float:
        """The smaller clearance in m."""
        return min(self.plus, self.minus)

    def clearance_on(self, side: int) -> float:
        """Return the clearance in m on a ``side``, 1 or -1; inf where there is no stop."""
        if side > 0:
            return self.plus
        return self.minus

    def force(self, w: float) -> float:
        """Return elastic force in N at the relative displacement ``w`` in m, without what a static load balances."""
        elastic = self.law.elastic_force(w - self.plus) - self.law.elastic_force(-w - self.minus)
        return float(elastic) - self.load

    def energy(self, w: float) -> float:
        """Return the energy in J of the contact and of the load at the relative displacement ``w`` in m, 0 at rest."""
        elastic = float(self.law.elastic_energy(w - self.plus) + self.law.elastic_energy(-w - self.minus))
        return elastic - self.energy_at_rest - self.load * w

    @property
    def is_pressed(self) -> bool:
        """Whether the contact is pressed at rest."""
        return self.clearance < 0

    @property
    def is_linear_at_rest(self) -> bool:
        """Whether motions about rest are linear up to where contacts open or close."""
        return not self.is_pressed or self.law.is_linear

    @property
    def slope_at_rest(self) -> float:
        """Stiffness in N/m for small motions about rest: the slope of the force of a pressed contact, else 0."""
        if not self.is_pressed:
            return 0.0
        return float(self.law.elastic_slope(-self.clearance))

    @property
    def energy_at_rest(self) -> float:
        """Elastic energy in J at rest."""
        plus, minus = (float(self.law.elastic_energy(-gap)) for gap in (self.plus, self.minus))
        return self.weight * (plus + minus)

    @property
    def load(self) -> float:
        """Force in N, on the side + positive, that a static load balances."""
        plus, minus = (float(self.law.elastic_force(max(-gap, 0.0))) for gap in (self.plus, self.minus))
        return self.weight * (plus - minus)
