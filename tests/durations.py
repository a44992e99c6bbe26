"""A plugin of pytest that writes the table of slow tests: ``scripts/test --durations``.

It measures the CPU time of each test function, as a mean over its parameters, with its fixtures and child processes.
CPU times depend little on what else the machine does. Tests that are not slow together take about a minute; so that
this stays so, a function with hundreds of parameters is slow too.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest

TABLE = Path(__file__).with_name("slow_tests.txt")
# CPU seconds from which on a test function is slow: the mean over its parameters, and all of them together.
MEAN = 0.1
TOGETHER = 4.0
SECONDS: Counter[str] = Counter()
PARAMETERS: Counter[str] = Counter()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """Add the CPU time of a test to that of its function."""
    name = getattr(item, "originalname", item.name)
    before = sum(os.times()[:4])
    ended = yield
    SECONDS[name] += sum(os.times()[:4]) - before
    PARAMETERS[name] += 1
    return ended


def pytest_sessionfinish() -> None:
    """Write the names of the slow test functions, one a line."""
    names = []
    for name, seconds in sorted(SECONDS.items()):
        if seconds >= TOGETHER or seconds / PARAMETERS[name] >= MEAN:
            names.append(name)
    TABLE.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
