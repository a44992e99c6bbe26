"""The section ``[nfrc]``."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from vipetsc.case.case import Case
from vipetsc.case.nfrc.varied_key import is_key
from vipetsc.case.schema import Finite, Positive, Range, once
from vipetsc.case.section import Section, described, unit_at

Restitution = Annotated[float, Field(ge=0, le=1)]


class NfrcTable(Section):
    """Steady responses of the sites to an incident ``wave`` of a ``band``, or to a ``force`` on the driven mass.

    With ``drive.end`` the force is that of a wall that moves. The amplitude of a wave is the relative displacement that
    it alone would make at the first site, over the clearance there. There is a curve for each value in ``fixed``, each
    of the ``restitutions``, and each combination of the values in ``family``; over the path of a key the case is
    resolved anew at each value. Motions that are not ``symmetric``, w(t + T/2) = -w(t), have even harmonics too. Steps
    are in units of the clearance and of the amplitude that touches, or half the range of frequencies.
    """

    source: Literal["wave", "force"] = described(
        "source of the motion: an incident wave, or a harmonic force on the driven mass of `[drive]`", "wave"
    )
    infinite: bool | None = described(
        "whether the lattice continues to infinity beyond both ends, which a wave requires; default: true"
        " for equal cells without dashpots, but under a force only with contacts of the cell's pair",
        None,
    )
    open_ends: bool = described(
        "whether the lattice goes on for ever in the place of its absorbing ends, which then reflect"
        " nothing at any frequency",
        False,
    )
    band: Annotated[int, Field(ge=1)] | None = described(
        "pass band of the wave; default: the one with the largest group velocity at the frequency", None
    )
    direction: Literal["forward", "backward"] = described(
        "direction of the wave: towards higher or lower cells", "forward"
    )
    over: str = described(
        "parameter that varies along a curve: amplitude, frequency, or the path of a key (`contacts.clearance`)",
        "amplitude",
    )
    range: Range = described(
        "[low, high] of this parameter: amplitude (of a wave over the first clearance, of a force in N, of"
        " a wall in m), rad/s, or the key's unit",
        [0.5, 2.0],
    )
    fixed: Annotated[list[Positive], AfterValidator(once)] = described(
        "values of the parameter that does not vary, one curve each. Over the amplitude: frequencies in"
        " rad/s; default: that of the drive. Over the frequency or a key: amplitudes, which are required",
        [],
    )
    restitutions: Annotated[list[Restitution], AfterValidator(once)] = described(
        "values of the restitution, one curve each; default: that of `[contacts]`", []
    )
    family: dict[str, Any] | None = described(
        "further keys of the case with their values (lists or ranges, as in `[sweep]`); curves for each combination",
        None,
    )
    harmonics: int = described("number of the last harmonic of the motion", 41, ge=1, le=2000)
    truncation: Positive | None = described(
        "fraction of a motion in the neglected harmonics up to which fewer than `harmonics` are taken along a curve;"
        " default: all at every state",
        None,
    )
    symmetric: bool | None = described("odd harmonics only: w(t + T/2) = -w(t)", None)
    subharmonic: int = described(
        "period of the motion over that of the drive; above 1 subharmonic motions are looked for at the places of"
        " `isolas`",
        1,
        ge=1,
        le=20,
    )
    isolas: int = described(
        "number of places within the range at which isolated curves (isolas) are looked for; 0: none", 0, ge=0, le=1000
    )
    isola_reach: float = described(
        "factor up to which amplitudes are larger or smaller that are followed to isolated curves", 10.0, gt=1, le=1e3
    )
    switch: Annotated[list[Literal["branch-point", "period-doubling"]], AfterValidator(once)] = described(
        "kinds of special points at which the curves that cross are followed, with the harmonics that they need", []
    )
    curves_of: Annotated[
        list[Literal["fold", "branch-point", "period-doubling", "neimark-sacker"]], AfterValidator(once)
    ] = described(
        "kinds of special points on curves over the frequency that are followed over frequency and amplitude, the"
        " latter up to the factor `isola_reach`",
        [],
    )
    special_points: Literal["stability", "all"] = described(
        "special points other than folds: where states become stable or unstable, or all where the number"
        " of growing perturbations changes",
        "stability",
    )
    points_at: dict[str, list[Finite]] = described(
        "quantities (`frequency`, `amplitude`, `largest`, `largest/2`, `peak_acceleration/name`) with values at which"
        " points are stored, wherever a curve passes them",
        {},
    )
    points: int = described("largest number of points of a curve", 1000, ge=1)
    first_step: Positive = described("first arclength step, in clearances and scaled parameters", 0.02)
    smallest_step: Positive = described("arclength step below which a curve ends", 1e-9)
    largest_step: Positive = described("largest arclength step", 0.1)
    tolerance: Positive = described("largest norm of the residual over the clearance", 1e-11)
    max_newton: int = described("largest number of Newton steps", 10, ge=1)

    @classmethod
    def unit_of(cls, key: str, table: Mapping[str, Any]) -> str:
        """Return the unit of a ``key``; frequencies that vary, or are fixed, are in rad/s."""
        over = table.get("over", "amplitude")
        if key == "range" and is_key(over):
            return unit_at(Case.sections(), over, {})
        if (key, over) in (("range", "frequency"), ("fixed", "amplitude")):
            return "rad/s"
        return super().unit_of(key, table)

    @property
    def varies_key(self) -> bool:
        """Whether a key of the case varies along the curves."""
        return is_key(self.over)

    @property
    def towards(self) -> int:
        """+1 for a wave to higher cells, -1 to lower ones."""
        return 1 if self.direction == "forward" else -1
