"""A plugin of pytest that writes the table of slow tests: ``scripts/test --durations``.

It measures the CPU time of each test function with all its parameters, set-up of fixtures and processes that it starts.
CPU times do not depend on what else the machine does, and tests that are not slow together take less than a minute.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path

import pytest

TABLE = Path(__file__).with_name("slow_tests.txt")
# CPU seconds of a test function, from which on it is slow.
SLOW = 0.25
SECONDS: Counter[str] = Counter()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    """Add the CPU time of a test to that of its function."""
    before = sum(os.times()[:4])
    ended = yield
    SECONDS[item.nodeid.partition("[")[0]] += sum(os.times()[:4]) - before
    return ended


def pytest_sessionfinish() -> None:
    """Write the names of the slow test functions, one a line."""
    names = sorted(name for name, seconds in SECONDS.items() if seconds >= SLOW)
    TABLE.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
