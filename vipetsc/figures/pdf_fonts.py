"""Fonts in PDF files: the letters that a picture has, without the tables by which programs set text."""

from collections.abc import Iterator
from contextlib import contextmanager

# Ligatures, kerning and classes of letters. Matplotlib places each letter itself. Of these tables fontTools would read
# and cut down all, which takes more than half of the time of a font, and keep letters that no picture shows.
OF_TYPESETTING = ("GSUB", "GPOS", "GDEF")


@contextmanager
def plain_fonts() -> Iterator[None]:
    """Embed fonts without the tables of typesetting within the block."""
    # Loads the tools for fonts, which take a quarter of the time that matplotlib itself takes.
    from fontTools.subset import Options  # type: ignore[import-untyped]

    dropped = Options._drop_tables_default
    Options._drop_tables_default = [*dropped, *OF_TYPESETTING]
    try:
        yield
    finally:
        Options._drop_tables_default = dropped
