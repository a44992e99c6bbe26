"""Coarse pictures, for tests that look at files only."""

from __future__ import annotations

from collections.abc import Callable


def coarse_pictures(replace: Callable[[object, str, object], None]) -> None:
    """Make pictures coarse and leave out their layout, the slowest step; ``replace`` acts as ``setattr`` does."""
    from vipetsc.figures import style
    from vipetsc.figures.style import remove_engine

    replace(style, "SCREEN", 80)
    replace(style, "_lay_out", remove_engine)
