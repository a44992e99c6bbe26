"""A store of the values computed last, for quantities that neighbouring states of a branch ask for again."""

from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Argument = TypeVar("Argument", bound=Hashable)
Value = TypeVar("Value")


class BoundedCache(Generic[Argument, Value]):
    """The ``count`` values that were computed last, found by their arguments.

    ``functools.lru_cache`` on a method would do the same, but would keep its object alive, and with it matrices of a
    whole lattice, until Python's garbage collector runs.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        self._values: dict[Argument, Value] = {}

    def get(self, argument: Argument, compute: Callable[[], Value]) -> Value:
        """Return value of an ``argument``, by ``compute`` if it is not kept; what ``compute`` raises is passed on."""
        if argument not in self._values:
            value = compute()
            if len(self._values) == self._count:
                oldest = next(iter(self._values))
                del self._values[oldest]
            self._values[argument] = value
        return self._values[argument]
