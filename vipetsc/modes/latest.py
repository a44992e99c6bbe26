"""The latest values of a function of which neighbouring states of a branch need the same ones."""

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Argument = TypeVar("Argument", bound=Hashable)
Value = TypeVar("Value")


class LatestValues(Generic[Argument, Value]):
    """The ``count`` values that were computed last, by their arguments.

    A cache of ``functools`` on a method would keep its object alive until the collector of cycles comes by, and
    with it matrices of a whole lattice.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._values: dict[Argument, Value] = {}

    def get(self, argument: Argument, compute: Callable[[], Value]) -> Value:
        """The value of an ``argument``, by ``compute`` if it is not kept; what ``compute`` raises is passed on."""
        if argument not in self._values:
            value = compute()
            if len(self._values) == self._count:
                oldest = next(iter(self._values))
                del self._values[oldest]
            self._values[argument] = value
        return self._values[argument]
