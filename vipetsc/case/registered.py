"""Laws and factors that users' modules register: what is wrong with their parameters, and with their formulas."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from vipetsc.case.section import Problem
from vipetsc.lattice import Contact
from vipetsc.lattice.contact import registered_factor, registered_law
from vipetsc.plugins import call, number_of
from vipetsc.register import Parameter
from vipetsc.wording import with_unit

# Indentations in m at which force, slope and energy of a law are compared with each other, and those between which the
# power is measured with which its force begins.
DEPTHS = np.geomspace(1e-6, 1e-3, 7)
ONSET = np.array([1e-9, 1e-8])
# Relative difference of a derivative from a central difference quotient, and the step of the quotient over x. The
# quotient of a power of x is exact to 1e-10, and a wrong factor or exponent in a formula differs by far more.
CLOSE = 1e-5
STEP = 1e-5
# Difference of the power with which a force begins from the one that is stated: it distinguishes 1, 1.5 and 2, and
# allows for terms of higher order at the onset.
POWER_CLOSE = 0.05


def check_parameters(
    path: str, given: Mapping[str, float], parameters: Mapping[str, Parameter], owner: str
) -> Iterator[Problem]:
    """Yield problems with numbers ``given`` at a ``path`` for ``parameters`` of an ``owner``, as 'the law "stop"'."""
    for key in sorted(given.keys() - parameters.keys()):
        remedy = f"{owner} takes {', '.join(parameters) or 'no parameters'}"
        yield Problem(f"{path}.{key}", given[key], remedy)
    for key, about in parameters.items():
        value = given.get(key)
        if value is None:
            yield Problem(f"{path}.{key}", None, with_unit(f"missing; needed for {owner}", about.unit))
        elif not about.least <= value <= about.most:
            bounds = f"must be from {about.least:g} to {about.most:g}"
            yield Problem(f"{path}.{key}", value, with_unit(bounds, about.unit))


def check_law_parameters(
    path: str, laws: Sequence[str], given: Sequence[Mapping[str, float] | None]
) -> Iterator[Problem]:
    """Yield problems with the parameters ``given`` for the ``laws`` (site,) of sites, at a ``path``."""
    # Parameters that the law of any site takes.
    every: dict[str, Parameter] = {}
    for name in laws:
        law = registered_law(name)
        if law:
            every |= law.parameters
    names = ", ".join(f'"{name}"' for name in dict.fromkeys(laws))
    # Sites of equal laws and parameters are checked once.
    pairs = {(name, tuple(sorted((values or {}).items()))) for name, values in zip(laws, given, strict=True)}

    problems: dict[str, Problem] = {}
    for name, values in sorted(pairs):
        law = registered_law(name)
        taken: Mapping[str, Parameter] = {}
        owner = f"the law {names}"
        if law:
            taken = law.parameters
            owner = f'the law "{name}"'
        # Parameters of other sites' laws are no problem: one section may give those of all laws.
        relevant = {key: value for key, value in values if key in taken or key not in every}
        for problem in check_parameters(path, relevant, taken, owner):
            problems.setdefault(problem.key, problem)
    yield from problems.values()


def check_law(law: Contact) -> str:
    """Return the first defect of the formulas of a registered ``law`` in words; empty without one."""
    try:
        force = law.elastic_force(DEPTHS)
        slope = law.elastic_slope(DEPTHS)
        energy = law.elastic_energy(DEPTHS)
        force_at_rest = float(law.elastic_force(0.0))
        slope_at_rest = float(law.elastic_slope(0.0))
        energy_at_rest = float(law.elastic_energy(0.0))
        onset = law.elastic_force(ONSET)
    except ValueError as error:
        return str(error)

    values = [*force, *slope, *energy, force_at_rest, slope_at_rest, energy_at_rest, *onset]
    if not np.isfinite(values).all():
        return f"its force, slope or energy is not a number at some x from 0 to {DEPTHS[-1]:g} m"
    if force_at_rest != 0 or energy_at_rest != 0:
        return f"its force and energy at x = 0 are {force_at_rest:g} and {energy_at_rest:g}; both must be 0"
    if not ((force > 0).all() and (onset > 0).all() and (slope >= 0).all()):
        return "its force must be positive for x > 0, and must not fall"

    # Steps in proportion to the indentations, which span three decades.
    step = STEP * DEPTHS
    quotient = (law.elastic_force(DEPTHS + step) - law.elastic_force(DEPTHS - step)) / (2 * step)
    work = (law.elastic_energy(DEPTHS + step) - law.elastic_energy(DEPTHS - step)) / (2 * step)
    for name, stated, expected in (("slope", slope, quotient), ("energy's derivative", force, work)):
        worst = int(np.argmax(np.abs(stated / expected - 1)))
        if not abs(stated[worst] / expected[worst] - 1) < CLOSE:
            values_there = f"{stated[worst]:.6g}, not {expected[worst]:.6g}"
            if name == "slope":
                return f"its slope at x = {DEPTHS[worst]:.3g} m is {values_there} as the differences of its force"
            return f"its force at x = {DEPTHS[worst]:.3g} m is {values_there} as the differences of its energy"

    power = float(np.log(onset[1] / onset[0]) / np.log(ONSET[1] / ONSET[0]))
    if abs(power - law.onset_exponent) > POWER_CLOSE:
        return f"its force begins as x^{power:.3g}, and onset_exponent is {law.onset_exponent:g}"
    return ""


def check_factors(path: str, names: Iterable[str], restitutions: Iterable[float]) -> Iterator[Problem]:
    """Yield problems with the values of registered factors: those ``names`` (site,) for the ``restitutions`` (site,).

    Raises PartError for a factor that fails.
    """
    for name, restitution in sorted(set(zip(names, restitutions, strict=True)), key=str):
        factor = registered_factor(name or "")
        if factor is None or restitution < factor.least_restitution:
            continue
        value = number_of(factor, call(factor, factor.function, restitution), "factor c")
        if not 0 <= value < np.inf:
            remedy = f"in {factor.file} gives c = {value:g} for the restitution {restitution:g}; it must be 0 or more"
            yield Problem(path, name, remedy)
