"""The program with coarse pictures, for tests that look at files only: ``python -m tests.coarse ARGUMENTS``."""

from __future__ import annotations

import sys
from collections.abc import Callable


def coarse_pictures(replace: Callable[[object, str, object], None]) -> None:
    """Make pictures coarse and leave out their layout, the slowest step; ``replace`` acts as ``setattr`` does."""
    from vipetsc.figures import style
    from vipetsc.figures.layout import remove_engine

    replace(style, "SCREEN", 80)
    replace(style, "_lay_out", remove_engine)


def main() -> int:
    """Call the program with coarse pictures; returns its exit code."""
    coarse_pictures(setattr)

    from vipetsc.__main__ import main as vipetsc

    return vipetsc()


if __name__ == "__main__":
    sys.exit(main())
