"""Quintic Hermite interpolants in Bernstein form: their first root and their largest value in a step.

Bernstein coefficients bound a polynomial: one whose coefficients have one sign has no root, and halving the
interval sharpens the bound. That finds the first crossing even when two lie in one step.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_options = {"cache": True, "error_model": "numpy"}
_DEPTH = 64


@njit("void(f8, f8, f8, f8, f8, f8, f8, f8[::1])", **_options)
def bernstein(w0, v0, a0, w1, v1, a1, h, b):
    """Coefficients ``b`` (6,) on [0, 1] of the quintic with value, rate and acceleration given at both ends."""
    b[0] = w0
    b[1] = w0 + h * v0 / 5.0
    b[2] = w0 + 2.0 * h * v0 / 5.0 + h * h * a0 / 20.0
    b[3] = w1 - 2.0 * h * v1 / 5.0 + h * h * a1 / 20.0
    b[4] = w1 - h * v1 / 5.0
    b[5] = w1


@njit("f8(f8[::1], f8)", **_options)
def evaluate(b, s):
    """Value at s in [0, 1] by de Casteljau's scheme, for up to six coefficients."""
    c = np.empty(6)
    n = b.size
    c[:n] = b
    for k in range(1, n):
        for i in range(n - k):
            c[i] = (1.0 - s) * c[i] + s * c[i + 1]
    return c[0]


@njit("f8(f8[::1])", **_options)
def _bisect(c):
    """Root in [0, 1] of a polynomial that turns from negative to positive once."""
    a, b = 0.0, 1.0
    for _ in range(53):
        s = 0.5 * (a + b)
        if evaluate(c, s) > 0.0:
            b = s
        else:
            a = s
    return b


@njit("f8(f8[::1])", **_options)
def first_upcrossing(b):
    """Smallest s in [0, 1] at which the polynomial turns positive; 2 if it never does."""
    n = b.size
    stack = np.empty((_DEPTH + 2, 6))
    low = np.empty(_DEPTH + 2)
    width = np.empty(_DEPTH + 2)
    top = 0
    stack[0, :n] = b
    low[0], width[0] = 0.0, 1.0
    left = np.empty(6)
    while top >= 0:
        c = stack[top, :n].copy()
        at, size = low[top], width[top]
        top -= 1
        if c[0] > 0.0:
            return at
        if c.max() <= 0.0:
            continue
        changes = 0
        for i in range(1, n):
            changes += (c[i - 1] <= 0.0) != (c[i] <= 0.0)
        if changes == 1 and c[n - 1] > 0.0:
            return at + size * _bisect(c)
        if size < 1e-13:
            return at
        for k in range(1, n):
            left[k - 1] = c[0]
            for i in range(n - k):
                c[i] = 0.5 * (c[i] + c[i + 1])
        left[n - 1] = c[0]
        # The right half is looked at only if the left half has no rise.
        top += 1
        stack[top, :n] = c
        low[top], width[top] = at + 0.5 * size, 0.5 * size
        top += 1
        stack[top, :n] = left[:n]
        low[top], width[top] = at, 0.5 * size
    return 2.0
