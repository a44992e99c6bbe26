"""A plugin of pytest that writes the table of slow tests: ``scripts/test --durations``.

It measures the CPU time of each test function, as a mean over its parameters, with its fixtures and child processes.
CPU times depend little on what else the machine does. Tests that are not slow together take about a minute; so that
this stays so, a function with hundreds of parameters is slow too, and each that uses a fixture which is: the first of
them pays for it, and one of the others is the first where that one is left out.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

TABLE = Path(__file__).with_name("slow_tests.txt")
# CPU seconds from which on a test function is slow: the mean over its parameters, and all of them together.
MEAN = 0.1
TOGETHER = 4.0
# CPU seconds from which on a fixture is slow.
FIXTURE = 1.0
SECONDS: Counter[str] = Counter()
PARAMETERS: Counter[str] = Counter()
SLOW_FIXTURES: set[str] = set()
FIXTURES: dict[str, set[str]] = {}


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any]):
    """Note a fixture whose set-up takes long."""
    before = sum(os.times()[:4])
    value = yield
    if sum(os.times()[:4]) - before >= FIXTURE:
        SLOW_FIXTURES.add(fixturedef.argname)
    return value


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """Add the CPU time of a test to that of its function."""
    name = getattr(item, "originalname", item.name)
    before = sum(os.times()[:4])
    ended = yield
    SECONDS[name] += sum(os.times()[:4]) - before
    PARAMETERS[name] += 1
    FIXTURES[name] = set(item.fixturenames)
    return ended


def pytest_sessionfinish() -> None:
    """Write the names of the slow test functions, one a line."""
    names = []
    for name, seconds in sorted(SECONDS.items()):
        is_long = seconds >= TOGETHER or seconds / PARAMETERS[name] >= MEAN
        if is_long or FIXTURES[name] & SLOW_FIXTURES:
            names.append(name)
    TABLE.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
