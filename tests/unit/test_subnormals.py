"""Subnormal numbers as zeros: within the block alone, and in the steps of both engines."""

import platform
import sys

import numpy as np
import pytest

from tests.conftest import run_of, small_case
from vipetsc.dynamics.subnormals import subnormals_as_zero

SMALLEST = np.finfo(float).tiny  # 2.2e-308, the smallest number that is not subnormal
known = pytest.mark.skipif(
    (sys.platform, platform.machine()) != ("linux", "x86_64"), reason="subnormal numbers stay what they are here"
)


def half(number: float) -> float:
    """Half of a ``number`` by an operation of the processor, which no compiler has done before."""
    return float(np.multiply(number, 0.5))


def double(number: float) -> float:
    """Twice a ``number``."""
    return float(np.multiply(number, 2.0))


@known
def test_subnormal_results_and_operands_are_zeros_within_the_block_alone():
    subnormal = half(SMALLEST)
    assert 0 < subnormal < SMALLEST

    with subnormals_as_zero():
        result = half(SMALLEST)
        of_operand = double(subnormal)
        normal = half(2 * SMALLEST)
    # Compared after the block: within it a subnormal number is equal to zero.
    assert result == 0
    assert of_operand == 0
    assert normal == SMALLEST
    assert half(SMALLEST) == subnormal

    with pytest.raises(KeyError), subnormals_as_zero():
        raise KeyError
    assert double(subnormal) == SMALLEST


@known
@pytest.mark.parametrize("engine", ["propagator", "ts"])
def test_ahead_of_the_front_nothing_is_subnormal(engine):
    case = small_case(lattice={"preset": "four-band", "cells": 100}, time={"end": 0.03, "engine": engine})
    size = np.abs(run_of(case)["velocity"].values)

    # The front goes through the smallest numbers: some are not far above these, none is below.
    assert size[size > 0].min() < 1e-290
    assert size[size > 0].min() >= SMALLEST
