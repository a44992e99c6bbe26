"""Fonts in PDF files: the letters that a picture has, without the tables by which programs set text."""

from collections.abc import Iterator
from contextlib import contextmanager

# Tables of ligatures, kerning and classes of letters. They are of no use, since matplotlib places each letter itself.
# To cut them down to a picture's letters takes fontTools more than half of its time for a font, and keeps further
# letters, to which ligatures refer.
TYPESETTING_TABLES = ("GSUB", "GPOS", "GDEF")


@contextmanager
def plain_fonts() -> Iterator[None]:
    """Embed fonts without the tables of typesetting within the block."""
    # Loads the tools for fonts, which take a quarter of the time that matplotlib itself takes.
    from fontTools.subset import Options  # type: ignore[import-untyped]

    dropped = Options._drop_tables_default
    Options._drop_tables_default = [*dropped, *TYPESETTING_TABLES]
    try:
        yield
    finally:
        Options._drop_tables_default = dropped
