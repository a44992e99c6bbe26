"""Stops that harden, as rubber does: F = k x (1 + b x^2) at the indentation x."""

from vipetsc import register

__version__ = "1.0"


def force(x: float, k: float, b: float) -> float:
    """Return the elastic force in N."""
    return k * x * (1 + b * x**2)


def slope(x: float, k: float, b: float) -> float:
    """Return the derivative of the force in N/m."""
    return k * (1 + 3 * b * x**2)


def energy(x: float, k: float, b: float) -> float:
    """Return the integral of the force from 0 to x in J."""
    return k * x**2 * (1 / 2 + b * x**2 / 4)


register.elastic_law(
    "rubber-stop",
    force,
    slope,
    energy,
    onset_exponent=1,
    parameters={"b": register.Parameter(unit="1/m^2", text="hardening, F = k x (1 + b x^2)", least=0)},
)
