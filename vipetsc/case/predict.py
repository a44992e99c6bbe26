"""The case of the verb ``predict``: a lattice run with its sites, and the amplitudes at which it is predicted."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import Valid
from vipetsc.case.law import LawCase
from vipetsc.case.schema import Positive
from vipetsc.case.section import Problem, Section, described
from vipetsc.case.warnings import end_warnings, length_warnings, wave_warnings
from vipetsc.case.waveforms import DEFAULT
from vipetsc.lattice.packet import narrow_fraction

# Amplitudes. By default each is simulated, too: with 0.3 s for a run, as of the built-in case, so many take an hour.
MOST = 10_000
# A scattering law has one frequency. If a pulse is no burst, at least the fraction NARROW of its energy must be in one
# band and within the fraction WIDTH of its main frequency. Predictions for such Gaussian pulses and chirps differ from
# runs by .044 to .122 decades (rms), and those for a burst by .056.
WIDTH = 0.3
NARROW = 0.95


class PredictTable(Section):
    """``amplitudes`` of the drive, in N or for a moved wall in m, at which the lattice is predicted."""

    amplitudes: list[Positive] = described(
        "amplitudes of the drive at which the lattice is predicted, in m of a wall that moves",
        [],
        unit="N or m",
        max_length=MOST,
    )
    count: int = described(
        "without `amplitudes`: number of amplitudes, log-spaced from the first contact", 19, ge=1, le=MOST
    )
    span: Annotated[float, Field(gt=1, le=1e6)] = described(
        "without `amplitudes`: largest amplitude over that of the first contact", 100.0
    )
    points: int = described(
        "number of runs with a single site, from which the prediction is composed", 24, ge=16, le=1000
    )
    simulate: bool = described("whether the lattice is also simulated at these amplitudes, for comparison", True)


class PredictCase(LawCase):
    """A case of the verb ``predict``: that of a law, with its sites, and ``[predict]``."""

    predict: PredictTable

    verb = section = "predict"
    refuses: ClassVar[Mapping[str, str]] = {
        feature: reason
        for feature, reason in LawCase.refuses.items()
        if feature not in ("absorbing ends", "other waveforms")
    } | {"damped wall": "not yet: a moved wall acts through its spring alone"}

    def warnings(self) -> list[str]:
        """Return warnings about the waves of the prediction; its runs do not store fields."""
        model = self.model()
        warnings = [*wave_warnings(model), *length_warnings(model), *end_warnings(model, self.output)]
        # Cells to the nearest site, in a ring along the shorter arc.
        offsets = [abs(site.cell - model.drive_cell) for site in model.chain.sites]
        nearest = min(min(offset, model.chain.cells - offset) for offset in offsets)
        # One revolution of the ring and on to the site, until the end of the burst has passed it.
        passed = (model.chain.cells + nearest) / model.speed + model.drive.duration
        if model.chain.ends == "periodic" and passed < model.end:
            warnings.append(
                f"the wave ({model.speed:.4g} cells/s) has passed a site for the second time at {passed:.4g} s, before"
                f" time.end = {model.end:.4g} s: sites that meet it several times are predicted less accurately"
            )
        return warnings

    def _place_problems(self) -> list[Problem]:
        """Return problems with the wave, which need not be a burst, and with the distance that the case gives."""
        return self._pulse_problems() or super()._place_problems()

    def _pulse_problems(self) -> list[Problem]:
        """Return problems with a wave without an end, or with one that is not narrow in frequency."""
        model = self.model()
        if not np.isfinite(model.drive.duration):
            remedy = "the wave must end; set drive.duration"
            return [Problem("drive.waveform", self.drive.kind, remedy)]
        narrow = narrow_fraction(model.chain.cell, model.drive, model.drive_mass, WIDTH)
        if self.drive.kind == DEFAULT or narrow >= NARROW:
            return []
        remedy = (
            f"a site responds to the amplitude of a wave of one frequency, and less than {NARROW:.0%} of the energy of"
            f" this one is in one band and within {WIDTH:.0%} of its main frequency; run accepts all"
        )
        return [Problem("drive.waveform", self.drive.kind, remedy)]

    @classmethod
    def check(cls, sections: dict[str, Any], valid: Valid) -> Iterator[Problem]:
        """Yield problems between keys."""
        yield from super().check(sections, valid)
        if valid("contacts.sites") and sections["contacts"].sites in (0, []):
            yield Problem("contacts.sites", [], "there are no sites; list their cells or give a count")
