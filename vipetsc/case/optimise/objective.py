"""Objectives and constraints of a search for a design, and their checks."""

from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal

from pydantic import WithJsonSchema

from vipetsc.case.amplitude import has_free_amplitude
from vipetsc.case.case import Case
from vipetsc.case.nfrc import RESPONSE, NfrcCase
from vipetsc.case.schema import Finite, Positive, PositiveRange
from vipetsc.case.section import Problem, Section, described
from vipetsc.lattice import pass_bands, wave_bands
from vipetsc.spectra.measures import PART, RunMeasure, measures_of
from vipetsc.wording import nearest

# Measures that only searches have; all others are numbers of every run, by their names.
OF_SEARCHES = ("upper_share_at_end", "ibtet", "band_share", "entropy", "transmitted")
# What editors propose: these, and any text.
MEASURES: dict[str, Any] = {"anyOf": [{"enum": list(OF_SEARCHES), "type": "string"}, {"type": "string"}]}
ABOVE_DRIVEN = ("upper_share_at_end", "ibtet")  # of the energy in the bands above the driven one
FILE_AMPLITUDE = "a state from a file is taken as it is, with the amplitude that it has"
# Numbers of a run's analysis that do not describe the lattice's motion.
NO_GOAL = ("ledger_error", "entropy/start", "bands/modal_energy")


class MeasuredTable(Section):
    """A measure of a design: of a band or a part of one, at some amplitudes.

    Energies are those at the run's end, over the energy that the lattice received (the drive's work, and the energy of
    its motion at t = 0). ``response/...`` is the largest value of a curve of ``[nfrc]``, or with ``below`` the width of
    the widest range in which it is below that level.
    """

    measure: Annotated[str, WithJsonSchema(MEASURES)] = described(
        "fraction of the work at the end in the upper bands, in one band, or beyond the last site; or"
        " ibtet, entropy (bit), or the name of any measure of a run; or response/ and a quantity of"
        " the curves of [nfrc]",
        "upper_share_at_end",
    )
    band: int | None = described("for band_share and measures with a value per band: the pass band", None, ge=1)
    part: PositiveRange | None = described(
        "for band_share: a part of that band; for responses a part of nfrc.range, in its unit", None, unit="rad/s"
    )
    amplitudes: list[Positive] = described(
        "amplitudes of the drive at which the measure is evaluated, or of the motion at t = 0 where"
        " nothing is driven (m, or m/s of the first struck mass); default: that of the case",
        [],
        unit="N or as the drive",
    )
    over: Literal["worst", "mean"] = described(
        "whether the worst value or the mean over the amplitudes, or the curves, counts", "worst"
    )
    below: Positive | None = described(
        "for responses: the width of the widest range in which the response is below this level, in its unit", None
    )

    @property
    def name(self) -> str:
        """The measure, with its band, part and level."""
        name = str(self.measure)
        if self.band:
            name += f" {self.band}"
        if self.part:
            name += f" {self.part[0]:g}-{self.part[1]:g}"
        if self.below:
            return f"width of {name} below {self.below:g}"
        return name

    @property
    def is_of_runs(self) -> bool:
        """Whether the measure is a number of every run, not one that only searches or frequency responses have."""
        return self.measure not in OF_SEARCHES and not self.is_of_responses

    @property
    def is_of_responses(self) -> bool:
        """Whether the measure is a number of frequency responses, which ``[nfrc]`` describes."""
        return str(self.measure).startswith(RESPONSE)

    def at_amplitudes(self, unit: str) -> str:
        """Return words that name the amplitudes, in their ``unit``, after the name of the measure; "" without any."""
        if not self.amplitudes:
            return ""
        amplitudes = ", ".join(f"{amplitude:g}" for amplitude in self.amplitudes)
        return f", the {self.over} at {amplitudes} {unit}"


class ObjectiveTable(MeasuredTable):
    """An objective: a measure, and the ``goal`` to maximise or minimise it."""

    goal: Literal["maximise", "minimise"] = described("whether the measure is maximised or minimised", "maximise")

    def describe(self, unit: str) -> str:
        """Return the objective in words; amplitudes have a ``unit``."""
        return f"{self.goal} {self.name}{self.at_amplitudes(unit)}"


class ConstraintTable(MeasuredTable):
    """Bounds of a measure, in its unit: it is to be ``at_least`` or ``at_most`` so much, or both."""

    at_least: Finite | None = described("lower bound, in the unit of the measure", None)
    at_most: Finite | None = described("upper bound, in the unit of the measure", None)

    def describe(self, unit: str) -> str:
        """Return the constraint in words; amplitudes have a ``unit``."""
        bounds = []
        if self.at_least is not None:
            bounds.append(f"at least {self.at_least:g}")
        if self.at_most is not None:
            bounds.append(f"at most {self.at_most:g}")
        return f"{self.name} {' and '.join(bounds)}{self.at_amplitudes(unit)}"

    def excess(self, value: float) -> float:
        """Return distance of a ``value`` beyond the bounds, over the bound's size (or 1 for a bound of 0); 0 inside."""
        # Relative, so that the excesses of different constraints can be added.
        below = above = 0.0
        if self.at_least is not None:
            below = (self.at_least - value) / (abs(self.at_least) or 1.0)
        if self.at_most is not None:
            above = (value - self.at_most) / (abs(self.at_most) or 1.0)
        return max(below, above, 0.0)


def measured_problems(
    objective: MeasuredTable, at: str, base: Case, varied: bool, responses: NfrcCase | None
) -> Iterator[Problem]:
    """Yield problems with an ``objective`` or a constraint at the path ``at``, for designs like the case ``base``.

    ``varied`` says that their cell is not that of ``base``. ``responses`` is the case of the frequency responses, None
    for a case without ``[nfrc]``, or with an invalid one.
    """
    if objective.amplitudes and not has_free_amplitude(base):
        yield Problem(f"{at}.amplitudes", objective.amplitudes, f"{FILE_AMPLITUDE}; remove them")
    if objective.below and not objective.is_of_responses:
        yield Problem(
            f"{at}.below", objective.below, "only measures of responses have a range below a level; remove it"
        )
    if objective.is_of_responses:
        yield from _problems_of_responses(objective, at, responses)
        return
    if not wave_bands(base.lattice.unit_cell()) and _is_of_bands(objective, base):
        remedy = "only contacts join the cells, so that there are no bands; use a measure of points or of contacts"
        yield Problem(f"{at}.measure", objective.measure, remedy)
        return
    if objective.is_of_runs:
        yield from _problems_of_runs(objective, at, base)
        return

    bands = pass_bands(base.lattice.unit_cell())
    band = objective.band
    part = objective.part

    # The upper edge of the driven band and of all that overlap it: bands from the lowest on, as long as the next one
    # begins below the edge reached so far.
    top = base.wave_frequency or 0.0
    for other in sorted(bands, key=lambda band: band.low):
        if other.low <= top:
            top = max(top, other.high)

    if objective.measure == "transmitted" and not base.model().chain.sites:
        remedy = "there is no site, beyond which energy could be; use another measure"
        yield Problem(f"{at}.measure", objective.measure, remedy)
    elif objective.measure == "transmitted" and base.lattice.ends == "periodic":
        remedy = "nothing lies beyond the last site of a ring; use lattice.ends = fixed or free, or another measure"
        yield Problem(f"{at}.measure", objective.measure, remedy)
    elif objective.measure in ABOVE_DRIVEN and base.wave_frequency is None:
        remedy = "masses that are struck send waves of all bands, and none is the driven one; use band_share"
        yield Problem(f"{at}.measure", objective.measure, remedy)
    elif objective.measure in ABOVE_DRIVEN and top >= max(b.high for b in bands):
        remedy = f"the driven band is the highest of {len(bands)}; use band_share of another, or drive a lower one"
        yield Problem(f"{at}.measure", objective.measure, remedy)
    elif (objective.measure == "band_share") != (band is not None):
        remedy = f"missing; band_share needs a band, 1 to {len(bands)}"
        if band:
            remedy = "only band_share has a band"
        yield Problem(f"{at}.band", band, remedy)
    elif band and band > len(bands):
        yield Problem(f"{at}.band", band, f"the cell has {len(bands)} bands")
    elif part and not band:
        yield Problem(f"{at}.part", part, "only band_share has a part of a band")
    elif part and band:
        low = bands[band - 1].low
        high = bands[band - 1].high
        # Where the cell varies, so do the edges of the band.
        if not varied and (part[1] <= low or part[0] >= high):
            yield Problem(f"{at}.part", part, f"must meet band {band}, {low:.5g}-{high:.5g} rad/s")


def _is_of_bands(objective: MeasuredTable, base: Case) -> bool:
    """Return whether an ``objective`` of runs of ``base`` is an energy of pass bands, or another number of one."""
    if objective.band or objective.measure in (*ABOVE_DRIVEN, "band_share"):
        return True
    measure = measures_of_runs(base).get(str(objective.measure))
    return measure is not None and (measure.dimension == PART or measure.group == "transfer")


def _problems_of_responses(objective: MeasuredTable, at: str, case: NfrcCase | None) -> Iterator[Problem]:
    """Yield problems with a measure of frequency responses."""
    name = str(objective.measure)
    if case is None:
        remedy = "is one of frequency responses; give their [nfrc], with its range and what is fixed"
        yield Problem(f"{at}.measure", name, remedy)
        return

    measures = case.measures()
    if name not in measures:
        remedy = f"is not a measure of these responses; {_nearest(name, [*measures])}"
        if not case.output.points:
            remedy += "; those of points need output.points, forces output.forces"
        yield Problem(f"{at}.measure", name, remedy)
    if objective.amplitudes:
        remedy = "responses have the amplitudes of [nfrc]; remove these"
        yield Problem(f"{at}.amplitudes", objective.amplitudes, remedy)
    if objective.band:
        yield Problem(f"{at}.band", objective.band, "responses have no bands; part is a part of nfrc.range")
    low, high = case.nfrc.range
    if objective.part and not (low <= objective.part[0] and objective.part[1] <= high):
        yield Problem(f"{at}.part", objective.part, f"must be within nfrc.range, {low:g} to {high:g}")


def _nearest(name: str, valid: Sequence[str]) -> str:
    """Return a remedy for an invalid ``name``: the nearest of the ``valid`` names, if near, and all of them."""
    near = nearest(name, valid)
    hint = ""
    if near:
        hint = f"did you mean {near!r}? "
    return f"{hint}There are {', '.join(valid)}"


def measures_of_runs(base: Case) -> dict[str, RunMeasure]:
    """Return the measures, by name, that every run of a case like ``base`` has, and that may be an objective."""
    points = [point.name for point in base.output.points or []]
    measures = measures_of(points, base.output.transmission or [])
    return {name: m for name, m in measures.items() if name not in NO_GOAL and m.dimension in ("", PART)}


def _problems_of_runs(objective: MeasuredTable, at: str, base: Case) -> Iterator[Problem]:
    """Yield problems with a measure of every run."""
    bands = len(pass_bands(base.lattice.unit_cell()))
    measures = measures_of_runs(base)
    name = str(objective.measure)
    if name not in measures:
        valid = [*OF_SEARCHES, *(name for name in measures if name not in OF_SEARCHES)]
        remedy = f"is not a measure of this case; {_nearest(name, valid)}"
        if not base.output.points:
            remedy += "; those of points need output.points"
        yield Problem(f"{at}.measure", name, remedy)
        return

    is_of_bands = measures[name].dimension == PART
    # A steady amplitude would be NaN in every run, and all designs would fail.
    if name.startswith("steady") and base.drive.kind != "harmonic":
        remedy = f"a {base.drive.kind} becomes no steady vibration; drive.waveform = harmonic, or peak and rms"
        yield Problem(f"{at}.measure", name, remedy)
    elif objective.part:
        yield Problem(f"{at}.part", objective.part, "only band_share has a part of a band")
    elif is_of_bands and not objective.band:
        yield Problem(f"{at}.band", None, f"missing; {name} needs a band, 1 to {bands}")
    elif objective.band and not is_of_bands:
        yield Problem(f"{at}.band", objective.band, f"{name} has no bands; leave it out")
    elif objective.band and objective.band > bands:
        yield Problem(f"{at}.band", objective.band, f"the cell has {bands} bands")
