"""The quintic Hermite interpolant of a gap over one step, and where it first rises through zero."""

from __future__ import annotations

from vipetsc.compiled import njit


@njit("f8(f8[::1], f8)", cache=True)
def _value(c, x):
    return c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * c[5]))))


@njit("f8(f8[::1], f8)", cache=True)
def _slope(c, x):
    return c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4] + x * 5.0 * c[5])))


@njit("void(f8[::1], f8[::1], f8, f8, f8, f8[::1])", cache=True)
def hermite(a, b, h, sign, offset, c):
    """Coefficients c (6,) of sign * w - offset on [0, 1] from (w, w', w'') at both ends of a step h."""
    g0, r0, s0 = sign * a[0] - offset, sign * a[1] * h, sign * a[2] * h * h
    g1, r1, s1 = sign * b[0] - offset, sign * b[1] * h, sign * b[2] * h * h
    d = g1 - g0 - r0 - 0.5 * s0
    e = r1 - r0 - s0
    f = s1 - s0
    c[0], c[1], c[2] = g0, r0, 0.5 * s0
    c[3] = 10.0 * d - 4.0 * e + 0.5 * f
    c[4] = -15.0 * d + 7.0 * e - f
    c[5] = 6.0 * d - 3.0 * e + 0.5 * f


@njit("f8(f8[::1])", cache=True)
def _start_slope(c):
    """Slope just after 0; a step that starts on an extremum has only rounding there."""
    return c[1] if abs(c[1]) > 1e-8 * abs(c[2]) else c[2]


@njit("f8(f8[::1], f8, f8)", cache=True)
def _extremum(c, low, high):
    """Zero of the slope, which changes sign between low and high (bisection)."""
    sign = _slope(c, low) if low > 0.0 else _start_slope(c)
    for _ in range(60):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if _slope(c, middle) * sign > 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


@njit("f8(f8[::1], f8, f8)", cache=True)
def _crossing(c, low, high):
    """First root between low (negative or zero) and high (positive)."""
    for _ in range(60):
        middle = 0.5 * (low + high)
        if middle in (low, high):
            break
        if _value(c, middle) > 0.0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)


@njit("Tuple((f8, i8))(f8[::1])", cache=True)
def first_upcrossing(c):
    """Where a gap that starts at or below zero first rises through it: (place in (0, 1], verdict).

    Verdict 0: nowhere; 1: a crossing there; 2: an extremum there, so near zero that only the flow itself can
    tell. The interval is cut in four so that a hump cannot hide beside another.
    """
    low = 0.0
    margin = 0.01 * (abs(c[5]) + 0.3 * abs(c[4]))  # above the interpolant's error
    for part in range(1, 5):
        high = 0.25 * part
        g = _value(c, high)
        start = _slope(c, low) if low > 0.0 else _start_slope(c)
        end = _slope(c, high)
        if g > 0.0:
            if start < 0.0 and end > 0.0:  # dips first: nothing between low and the dip
                low = _extremum(c, low, high)
            return _crossing(c, low, high), 1
        if start > 0.0 and end < 0.0:
            top = _extremum(c, low, high)
            peak = _value(c, top)
            if peak > margin:
                return _crossing(c, low, top), 1
            if peak > -margin:
                return top, 2
        low = high
    return 1.0, 0
