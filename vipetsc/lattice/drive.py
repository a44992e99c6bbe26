r"""Drives of a lattice: forces on masses, and motion of the walls that its ends are tied to.

A waveform F(t), in N or in m, is a tone burst, or pieces one after another; x being the time since a piece's start,

    F = (c_0 + c_1 x + ... + c_5 x^5) sin(p + w x + r x^2/2).

Ramps are 10 s^3 - 15 s^4 + 6 s^5, s from 0 to 1: two derivatives are continuous. Samples are joined in one of three
ways (``Interpolation``). A wall that moves by U(t) acts on the mass at the other end of a spring k as the force k U
would.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from math import factorial
from typing import Any, Literal, NamedTuple, Self

import numpy as np
import scipy
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike

Envelope = Literal["paper", "hann"]
Interpolation = Literal["monotone", "linear", "spline"]
"""How samples are joined: by cubics that stay between neighbouring samples, by straight lines, or by a cubic spline.

Monotone cubics (Fritsch and Carlson, SIAM J. Numer. Anal. 17 (1980) 238) have a continuous derivative. The spline has
no knot at the second sample and at the last but one; its error for a smooth force falls with the fourth power of the
distance of the samples, but between samples that are unevenly spaced or jump it exceeds them without a limit.
"""
COEFFICIENTS = ("c0", "c1", "c2", "c3", "c4", "c5")
PIECE = np.dtype([(name, float) for name in ("start", *COEFFICIENTS, "phase", "frequency", "rate")])
"""A piece of a waveform: its start in s, c_k in N/s^k, and of its sine p in rad, w in rad/s, r in rad/s^2."""
SMOOTH = np.array([0.0, 0.0, 0.0, 10.0, -15.0, 6.0])
"""Coefficients c_k of a ramp from 0 to 1 over s from 0 to 1."""
# Nodes of a panel of a Gauss quadrature, and the largest length of a panel in rad of the fastest oscillation that is
# integrated. Rounding is reached with a margin, since pieces are polynomials of degree 5 times a sine: half as many
# nodes or panels twice as long change a ramped sine's response by 2e-14, and take .6 of the time.
NODES = 16
PANEL = 4.0
# As many as nodes: the factors of both take the same memory.
PANELS_AT_ONCE = 16
# Periods beyond which a waveform's peak is not sought period by period: twenty instants in each are 16 MB.
MOST_PERIODS = 1e5


# The formulas of waveforms, as NumPy executes them here, and as ``dynamics.drives`` compiles them.
def burst(amplitude: Any, frequency: Any, cycles: Any, t: Any) -> Any:
    """Return the force (...) in N of a burst at times ``t`` (...) in s in it; ``amplitude`` is that before 1 - cos."""
    phase = frequency * t
    return amplitude * (1.0 - np.cos(phase / cycles)) * np.sin(phase)


def burst_rate(amplitude: Any, frequency: Any, cycles: Any, t: Any) -> Any:
    """Return the derivative (...) of ``burst`` by time in N/s."""
    phase = frequency * t
    slow = phase / cycles
    rate = np.sin(slow) / cycles * np.sin(phase) + (1.0 - np.cos(slow)) * np.cos(phase)
    return amplitude * frequency * rate


def piece_value(piece: Any, t: Any) -> Any:
    """Return the force (...) in N of a ``piece`` of dtype ``PIECE`` at times ``t`` (...) in s."""
    x = t - piece.start
    value = ((((piece.c5 * x + piece.c4) * x + piece.c3) * x + piece.c2) * x + piece.c1) * x + piece.c0
    return value * np.sin(piece.phase + x * (piece.frequency + 0.5 * piece.rate * x))


def piece_rate(piece: Any, t: Any) -> Any:
    """Return the derivative (...) of ``piece_value`` by time in N/s."""
    x = t - piece.start
    value = ((((piece.c5 * x + piece.c4) * x + piece.c3) * x + piece.c2) * x + piece.c1) * x + piece.c0
    slope = (((5 * piece.c5 * x + 4 * piece.c4) * x + 3 * piece.c3) * x + 2 * piece.c2) * x + piece.c1
    phase = piece.phase + x * (piece.frequency + 0.5 * piece.rate * x)
    return slope * np.sin(phase) + value * np.cos(phase) * (piece.frequency + piece.rate * x)


@dataclass(frozen=True)
class ToneBurst:
    """The drive of one mass, Eq. (3) of the paper: F(t) = A [1 - cos(Om t/Nc)] sin(Om t) for 0 < t < 2 pi Nc/Om.

    ``amplitude`` A in N, ``frequency`` Om in rad/s, ``cycles`` Nc. The paper's envelope peaks at 2A; the
    authors' code has a factor 1/2 before it, here ``envelope = "hann"``.
    """

    amplitude: float
    frequency: float
    cycles: int
    envelope: Envelope = "paper"

    @property
    def duration(self) -> float:
        """Length of the burst in s; 0 for the amplitude 0."""
        if not self.amplitude:
            return 0.0
        return 2 * np.pi * self.cycles / self.frequency

    @property
    def settled(self) -> float:
        """Time in s from which on the force is at rest or repeats itself."""
        return self.duration

    @property
    def repeats(self) -> bool:
        """Whether it is a sine that does not end: a burst ends."""
        return False

    @property
    def window_amplitude(self) -> float:
        """The factor in N before 1 - cos."""
        if self.envelope == "paper":
            return self.amplitude
        return self.amplitude / 2

    @property
    def peak(self) -> float:
        """The largest force in N."""
        return 2 * abs(self.window_amplitude)

    @property
    def highest(self) -> float:
        """The highest angular frequency in rad/s of the burst's three sines."""
        return self.frequency * (1.0 + 1.0 / self.cycles)

    @property
    def breaks(self) -> np.ndarray:
        """Times (break,) in s after the beginning at which the burst is not smooth."""
        return np.array([self.duration])

    def force(self, t: ArrayLike) -> np.ndarray:
        """Return the force (...) in N at times ``t`` (...) in s."""
        t = np.asarray(t, float)
        value = burst(self.window_amplitude, self.frequency, self.cycles, t)
        return np.where((t > 0) & (t < self.duration), value, 0.0)

    def rate(self, t: ArrayLike) -> np.ndarray:
        """Return the derivative (...) of the force in N/s at times ``t`` (...) in s."""
        t = np.asarray(t, float)
        rate = burst_rate(self.window_amplitude, self.frequency, self.cycles, t)
        return np.where((t > 0) & (t < self.duration), rate, 0.0)

    def spectrum(self, frequency: ArrayLike) -> np.ndarray:
        """Return Fourier transform (...) in N s at ``frequency`` (...) w in rad/s: the integral of F(t) exp(-i w t)."""
        w = np.asarray(frequency, float) * (1 + 1e-7j)  # off the poles, which the first factor cancels
        # [1 - cos(Om t/Nc)] sin(Om t) is the sum of three sines: their weights and frequencies. The one of frequency 0,
        # in a burst of one cycle, is 0 and must not be divided by w^2 = 0.
        lines = (
            (-0.5, self.frequency * (1 - 1 / self.cycles)),
            (1.0, self.frequency),
            (-0.5, self.frequency * (1 + 1 / self.cycles)),
        )
        sines = sum(weight * line / (line**2 - w**2) for weight, line in lines if line)
        return self.window_amplitude * (1 - np.exp(-1j * w * self.duration)) * np.asarray(sines)

    def response(self, frequency: np.ndarray, start: float, stop: float) -> np.ndarray:
        """Return the integral from ``start`` to ``stop`` of exp(i w (stop - s)) F(s) ds, (w,), in closed form."""
        end = min(max(stop, 0.0), self.duration)
        begin = min(max(start, 0.0), end)
        middle = (begin + end) / 2
        length = end - begin

        # [1 - cos(Om t/Nc)] sin(Om t) is three sines, each of two exponentials; the integral of an exponential over the
        # interval is a sinc, which stays finite where the frequencies agree.
        lines = ((1.0, 1.0), (-0.5, 1 + 1 / self.cycles), (-0.5, 1 - 1 / self.cycles))
        total = np.zeros(len(frequency), complex)
        for weight, factor in lines:
            for sign in (1, -1):
                detuning = sign * factor * self.frequency - frequency
                wave = np.exp(1j * (frequency * stop + detuning * middle))
                total += sign * weight / 2j * wave * np.sinc(detuning * length / (2 * np.pi))
        return total * self.window_amplitude * length


@dataclass(frozen=True)
class Pieces:
    """A waveform of pieces: ``table`` (piece,) of dtype ``PIECE``, scaled by ``amplitude`` already.

    It begins with the first piece and ends at ``duration`` in s, which may be inf. ``frequency`` in rad/s is its main
    one. ``cycles`` is the time for which it lasts, or rises if it does not end, in periods of that frequency, at least
    1. Waveforms are equal if their numbers and the ``digest`` of their tables are.
    """

    amplitude: float
    frequency: float
    duration: float
    cycles: float
    table: np.ndarray = field(compare=False, repr=False)
    digest: str = ""

    @classmethod
    def of(cls, amplitude: float, frequency: float, duration: float, table: np.ndarray) -> Self:
        """Return the waveform of a ``table`` (piece,) of coefficients in which the amplitude is one."""
        table = table.copy()
        for name in COEFFICIENTS:
            table[name] *= amplitude
        # Without an end the last piece is what is held: the waveform rises up to its beginning.
        length = duration
        if not np.isfinite(duration):
            length = table["start"][-1]
        return cls(
            amplitude=amplitude,
            frequency=frequency,
            duration=duration,
            cycles=max(frequency * length / (2 * np.pi), 1.0),
            table=table,
            digest=hashlib.sha256(table.tobytes()).hexdigest(),
        )

    @property
    def settled(self) -> float:
        """Time in s from which on the force is at rest or repeats itself: the end, or that of the ramp without one."""
        if np.isfinite(self.duration):
            return self.duration
        return float(self.table["start"][-1])

    @property
    def breaks(self) -> np.ndarray:
        """Times (break,) in s after the beginning at which the waveform is not smooth."""
        times = np.append(self.table["start"], self.duration)
        return times[(times > 0) & np.isfinite(times)]

    @cached_property
    def highest(self) -> float:
        """The highest angular frequency in rad/s of the pieces' sines; 0 of polynomials."""
        starts = self.table["start"]
        ends = np.append(starts[1:], self.settled)
        # A sweep is linear in time: it is fastest at an end of its piece.
        at_start = self.table["frequency"]
        at_end = at_start + self.table["rate"] * (ends - starts)
        return float(np.max([np.abs(at_start), np.abs(at_end)]))

    @cached_property
    def peak(self) -> float:
        """The largest force in N, at twenty instants a piece, and twenty a period."""
        starts = self.table["start"]
        end = max(self.settled, float(starts[0]))
        # Twenty instants a period miss the top of a sine by 1 - cos(pi/20), 1.2 %, at most.
        period = 2 * np.pi / (self.highest or self.frequency)
        ends = np.append(starts[1:], end + period)
        times = [np.linspace(a, b, 20) for a, b in zip(starts, ends, strict=True)]
        if (end - starts[0]) / period < MOST_PERIODS:
            times.append(np.arange(starts[0], end + period, period / 20))
        return float(np.abs(self.force(np.concatenate(times))).max())

    def force(self, t: ArrayLike) -> np.ndarray:
        """Return the force (...) in N at times ``t`` (...) in s."""
        t = np.asarray(t, float)
        value = piece_value(self._piece(t), t)
        return np.where((t >= self.table["start"][0]) & (t < self.duration), value, 0.0)

    def rate(self, t: ArrayLike) -> np.ndarray:
        """Return the derivative (...) of the force in N/s at times ``t`` (...) in s."""
        t = np.asarray(t, float)
        rate = piece_rate(self._piece(t), t)
        return np.where((t >= self.table["start"][0]) & (t < self.duration), rate, 0.0)

    def phase(self, t: ArrayLike) -> np.ndarray:
        """Return phase (...) in rad of the sine at times ``t`` (...) in s."""
        t = np.asarray(t, float)
        piece = self._piece(t)
        x = t - piece.start
        return np.asarray(piece.phase + x * (piece.frequency + 0.5 * piece.rate * x))

    def _piece(self, t: np.ndarray) -> Any:
        """Return the piece at each time t in s, with its numbers as attributes; before the beginning the first one."""
        number = np.searchsorted(self.table["start"], t, side="right") - 1
        return self.table.view(np.recarray)[np.maximum(number, 0)]

    @property
    def repeats(self) -> bool:
        """Whether it is a sine that does not end; a constant that does not end is held."""
        last = self.table[-1]
        return not np.isfinite(self.duration) and bool(last["frequency"] or last["rate"])

    def spectrum(self, frequency: ArrayLike) -> np.ndarray:
        """Return Fourier transform (...) in N s at ``frequency`` (...) w in rad/s: the integral of F(t) exp(-i w t).

        The integral is taken by quadrature; a value that is held for ever adds the transform of a step. Raises
        ValueError for a sine that does not end.
        """
        if self.repeats:
            raise ValueError("a waveform without an end has no spectrum; give a duration")
        w = np.asarray(frequency, float)
        end = self.settled
        values = self.response(w.ravel(), 0.0, end).reshape(w.shape)
        if not np.isfinite(self.duration):
            values = values + self.force(end) / (1j * w)
        return np.asarray(values * np.exp(-1j * w * end))

    def response(self, frequency: np.ndarray, start: float, stop: float) -> np.ndarray:
        """Return integral from ``start`` to ``stop`` of exp(i w (stop - s)) F(s) ds, (w,), by Gauss's quadrature."""
        starts = self.table["start"]
        end = min(max(stop, 0.0), self.duration)
        begin = min(max(start, float(starts[0])), end)
        # Panels end where the waveform is not smooth, and are shorter than a period of what is integrated.
        cuts = np.unique([begin, *starts[(starts > begin) & (starts < end)], end])
        fastest = float(np.abs(frequency).max(initial=0.0)) + self.highest
        nodes, weights = leggauss(NODES)

        total = np.zeros(len(frequency), complex)
        for a, b in pairwise(cuts):
            panels = int(fastest * (b - a) / PANEL) + 1
            half = (b - a) / (2 * panels)
            begins = a + 2 * half * np.arange(panels)
            later = half * (1 + nodes)
            weighted = self.force(begins[:, None] + later) * weights * half

            # exp(i w (stop - s)) is a factor of the panel's beginning times one of the nodes. All panels have that of
            # the nodes in common; that of the beginnings is computed for a few panels at a time, since frequencies may
            # be many.
            at_nodes = np.exp(-1j * np.multiply.outer(frequency, later))
            for first in range(0, panels, PANELS_AT_ONCE):
                some = slice(first, first + PANELS_AT_ONCE)
                at_begins = np.exp(1j * np.multiply.outer(frequency, stop - begins[some]))
                total += (at_begins * (at_nodes @ weighted[some].T)).sum(axis=1)
        return total


Waveform = ToneBurst | Pieces


@dataclass(frozen=True)
class Drive:
    """A ``waveform`` that acts on a ``mass`` of a ``cell`` (0-based): a force in N.

    With a ``stiffness`` k in N/m, not 0, the waveform is the motion U of a wall to which a spring k ties that mass, and
    the force is k U. With a ``damping`` c in N s/m, not 0, a dashpot ties it to the wall, and the force is c U'. A
    spring with a dashpot makes two drives.
    """

    waveform: Waveform
    cell: int
    mass: int
    stiffness: float = 0.0
    damping: float = 0.0

    @property
    def scale(self) -> float:
        """What the waveform is multiplied by: 1 of a force, N/m of a spring, N s/m of a dashpot."""
        return self.damping or self.stiffness or 1.0

    @property
    def force_per_amplitude(self) -> float:
        """The force in N by a waveform of 1 at its main frequency."""
        if self.damping:
            return abs(self.damping) * self.waveform.frequency
        return abs(self.scale)

    def response(self, frequency: np.ndarray, start: float, stop: float) -> np.ndarray:
        """Return the integral from ``start`` to ``stop`` of exp(i w (stop - s)) F(s)/``scale`` ds, at each w (w,)."""
        response = self.waveform.response(frequency, start, stop)
        if self.damping:
            # By parts, since only the waveform's own integral is at hand.
            at_start, at_stop = self.waveform.force([start, stop])
            response = at_stop - np.exp(1j * frequency * (stop - start)) * at_start + 1j * frequency * response
        return np.asarray(response)


def _table(starts: ArrayLike) -> np.ndarray:
    """Return pieces that begin at ``starts`` in s, all zero, with a sine of 1, so that polynomials are left."""
    table = np.zeros(np.size(starts), PIECE)
    table["start"] = starts
    table["phase"] = np.pi / 2
    return table


def _set(row: np.ndarray, coefficients: np.ndarray) -> None:
    """Write the ``coefficients`` c_k of a piece to its ``row``."""
    for name, value in zip(COEFFICIENTS, coefficients, strict=False):
        row[name] = value


def ramped(
    amplitude: float,
    frequency: float,
    ramp: float,
    duration: float = np.inf,
    sweep: float | None = 0.0,
    phase: float = 0.0,
) -> Pieces:
    """Return a sine of ``frequency`` in rad/s that rises over ``ramp`` s, and falls so before ``duration``, if any.

    Its ``phase`` in rad is that at the beginning. With a ``sweep`` its frequency goes linearly from half of that below
    to half of it above; without one (None) it is no sine, but a step. ``ramp`` is at most half the duration.
    """
    ends = np.isfinite(duration)
    starts = [0.0, ramp]
    if ends:
        starts.append(duration - ramp)
    table = _table(starts)
    rise = SMOOTH / ramp ** np.arange(6)
    _set(table[0], rise)
    table["c0"][1] = 1.0
    if ends:
        _set(table[2], np.eye(6)[0] - rise)

    if sweep is not None:
        lowest = frequency - sweep / 2
        rate = sweep / duration  # 0 of a sine that does not end
        x = table["start"]
        # Each piece goes on with the phase and the frequency that the sweep has reached.
        table["phase"] = phase + x * (lowest + 0.5 * rate * x)
        table["frequency"] = lowest + rate * x
        table["rate"] = rate
    return Pieces.of(amplitude, frequency, duration, table)


def impulse(amplitude: float, duration: float) -> Pieces:
    """Return the half a sine of ``duration`` s whose integral is ``amplitude``, in N s."""
    table = _table([0.0])
    frequency = np.pi / duration
    table["phase"] = 0.0
    table["frequency"] = frequency
    table["c0"] = np.pi / (2 * duration)
    return Pieces.of(amplitude, frequency, duration, table)


class Joined(NamedTuple):
    """The ``curve`` through samples or its integral, and what was ``removed`` from the samples before: offset, drift.

    The drift is in the unit of the samples a second; both are () where nothing is integrated.
    """

    curve: "scipy.interpolate.PPoly"
    removed: np.ndarray

    @property
    def last(self) -> float:
        """The value at the end, 0 where that was removed."""
        return 0.0 if len(self.removed) else float(self.curve(self.curve.x[-1]))


def joined(
    times: ArrayLike,
    values: ArrayLike,
    interpolation: Interpolation = "monotone",
    derivative: int = 0,
    removes: bool = True,
) -> Joined:
    """Join ``values`` (sample,) at ``times`` (sample,); those of a ``derivative``, 1 or 2, are integrated, exactly.

    The integrals begin at 0. ``removes`` takes a polynomial of one degree less from the values first, so that all
    integrals also end at 0: an offset of a velocity, an offset and a drift of an acceleration.
    """
    times = np.asarray(times, float)
    curve = _joined(times, np.asarray(values, float), interpolation)
    removed = np.zeros(0)
    if not derivative:
        return Joined(curve, removed)

    if removes:
        # The n-fold integral of x^m over the length L is m!/(m+n)! L^(m+n).
        length = times[-1] - times[0]
        ends = [float(curve.antiderivative(n)(times[-1])) for n in range(1, derivative + 1)]
        powers = [
            [factorial(m) / factorial(m + n) * length ** (m + n) for m in range(derivative)]
            for n in range(1, derivative + 1)
        ]
        removed = np.linalg.solve(powers, ends)
        # SciPy has the highest power first. Pieces of the curve are linear at least.
        coefficients = curve.c.copy()
        coefficients[-1] -= np.polynomial.polynomial.polyval(times[:-1] - times[0], removed)
        coefficients[-2] -= np.append(removed, 0.0)[1]
        curve = scipy.interpolate.PPoly(coefficients, times)
    return Joined(curve.antiderivative(derivative), removed)


def sampled(
    amplitude: float,
    times: ArrayLike,
    values: ArrayLike,
    frequency: float,
    interpolation: Interpolation = "monotone",
    hold: bool = False,
) -> Pieces:
    """Return ``amplitude`` times the curve through ``values`` (sample,) at ``times`` (sample,), two or more.

    ``times`` in s since the drive's beginning rise from 0 or later; ``frequency`` in rad/s is the main one. The
    waveform is 0 before the first sample and from the last one on. With ``hold`` it keeps the last sample's value after
    that, unless this is 0.
    """
    return along(amplitude, joined(times, values, interpolation), frequency, hold)


def along(amplitude: float, motion: Joined, frequency: float, hold: bool = False) -> Pieces:
    """Return ``amplitude`` times the curve of a ``motion``, as ``sampled`` does with that through samples."""
    times = motion.curve.x
    # What is held at zero has ended, and has a duration.
    hold &= motion.last != 0
    starts = times[:-1]
    duration = float(times[-1])
    if hold:
        starts = times
        duration = np.inf
    table = _table(starts)
    # SciPy has the highest power first.
    for k, column in enumerate(motion.curve.c[::-1]):
        table[COEFFICIENTS[k]][: len(times) - 1] = column
    if hold:
        table["c0"][-1] = motion.last
    return Pieces.of(amplitude, frequency, duration, table)


# The annotation is a text: evaluated, it would load scipy.interpolate with the package.
def _joined(times: np.ndarray, values: np.ndarray, interpolation: Interpolation) -> "scipy.interpolate.PPoly":
    """Return the polynomials between samples ``values`` (sample,) at ``times`` (sample,)."""
    if interpolation == "linear":
        return scipy.interpolate.PPoly(np.array([np.diff(values) / np.diff(times), values[:-1]]), times)
    if interpolation == "spline":
        return scipy.interpolate.CubicSpline(times, values)
    return scipy.interpolate.PchipInterpolator(times, values)


def main_frequency(times: ArrayLike, values: ArrayLike, interpolation: Interpolation = "monotone") -> float:
    """Return the angular frequency in rad/s, not 0, at which the ``spectrum`` of samples is largest."""
    # A mean is not an oscillation.
    frequency, content = spectrum(times, values, interpolation)
    return float(frequency[1 + np.argmax(content[1:])])


def spectrum(
    times: ArrayLike, values: ArrayLike, interpolation: Interpolation = "monotone"
) -> tuple[np.ndarray, np.ndarray]:
    """Return angular frequencies (n,) in rad/s, and the magnitude (n,) of the transform of joined samples there.

    The samples are ``values`` (sample,) at the rising ``times`` (sample,) in s.
    """
    times = np.asarray(times, float)
    values = np.asarray(values, float)
    # As fine as the densest samples, but at most a million points: one pair of close samples must not fill the memory.
    steps = (times[-1] - times[0]) / np.diff(times).min()
    count = int(min(max(steps, 16), 2**20)) + 1
    even = np.linspace(times[0], times[-1], count)
    # Padded with zeros, the transform has four times as many frequencies as the record's length resolves.
    content = np.abs(np.fft.rfft(_joined(times, values, interpolation)(even), 4 * count))
    return 2 * np.pi * np.arange(len(content)) / (4 * count * (even[1] - even[0])), content
