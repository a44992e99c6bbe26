"""Parsed formulas of labels, kept for all pictures that are drawn together."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from matplotlib.mathtext import MathTextParser

# Formulas that are kept, each at a size and a resolution. Matplotlib keeps 50, fewer than the pages of a sweep have. To
# parse one takes 2 ms, to keep it some kB.
MOST_FORMULAS = 2000


@contextmanager
def kept_formulas() -> Iterator[None]:
    """Keep the formulas that are parsed within the block, until it ends."""
    parse = MathTextParser._parse_cached
    MathTextParser._parse_cached = lru_cache(MOST_FORMULAS)(parse.__wrapped__)
    try:
        yield
    finally:
        MathTextParser._parse_cached = parse
