"""How runs and branches end: one list of endings, each with its sentence.

The program asks which ending it is, and never what its sentence says.
"""

from enum import Enum
from typing import Any, NamedTuple


class Ending(Enum):
    """An ending of a run or a branch; its value is the sentence, with places for what it tells (``with_numbers``)."""

    NOT_FINISHED = "not finished"
    STOPPED = "stopped on request {where}"
    # Of runs.
    COMPLETE = "complete: {samples} samples to t = {end:.6g} s"
    BROKEN_OFF = "{reason}, at t = {time:.6g} s ({place}); last good sample: {good}"
    # Of branches that can go on, with more points or a change of the case.
    FAILED = "failed: {reason}"
    POINTS_USED = "{points} points reached: increase {key} and continue with --resume"
    # Of branches that have left their range.
    END_OF_RANGE = "reached the end of nfrc.range, {end:g}"
    END_OF_AMPLITUDES = "left the range of amplitudes by nfrc.isola_reach, at {end:g}"
    END_OF_PARAMETER = "reached p = {end:g}"
    OUT_OF_ENERGIES = "left the energy range {low:g} to {high:g} J"
    OUT_OF_FREQUENCIES = "left the frequency range {low:g} to {high:g} rad/s"
    EQUILIBRIUM = (
        "ends at an equilibrium: at E = {energy:.9g} J, f = {frequency:.6g} Hz the motion begins where the forces "
        "almost balance"
    )
    STOP_AT_REST = (
        "ends at a stop: at E = {energy:.9g} J, f = {frequency:.6g} Hz the motion comes to rest on a rigid stop, on "
        "the side where it has struck none; nnm follows no motion beyond it"
    )
    # Of branches that have met themselves or another one.
    CLOSED = "closed: it has come back to its first point"
    CLOSED_ON_ITSELF = "closed on itself: {where}"
    RETRACED = "retraces itself: {where}, backwards"
    LINEAR_MODE = "returned to linear mode {mode} at E = {energy:.6g} J (point {point})"
    STANDSTILL = "does not advance: {places} points up to {point} are one, at E = {energy:.9g} J"
    OTHER_BRANCH = "left its branch: the orbit of point {point} is another one passed {times} times"

    @property
    def is_final(self) -> bool:
        """Whether nothing is left to compute, since the run or the branch is complete."""
        return self not in INTERRUPTIONS

    def with_numbers(self, **values: Any) -> "Ended":
        """Return the ending with its sentence, in which the places have the ``values``."""
        return Ended(self, self.value.format(**values))


INTERRUPTIONS = (Ending.NOT_FINISHED, Ending.STOPPED, Ending.BROKEN_OFF, Ending.FAILED, Ending.POINTS_USED)


class Ended(NamedTuple):
    """An ``ending`` and the ``sentence`` about it."""

    ending: Ending
    sentence: str


NOT_FINISHED = Ending.NOT_FINISHED.with_numbers()
