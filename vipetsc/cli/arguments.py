"""Arguments of verbs: those that several verbs take. The module of a verb declares the others."""

from pathlib import Path
from typing import Any, NamedTuple


class Argument(NamedTuple):
    """An argument of a verb: its name or flag, and the keywords of ``argparse.ArgumentParser.add_argument``."""

    flag: str
    keywords: dict[str, Any]


def argument(flag: str, **keywords: Any) -> Argument:
    """The argument ``flag`` with these keywords of ``add_argument``."""
    return Argument(flag, keywords)


def case_with(section: str) -> Argument:
    """A case file that has to be given, because nothing stands in for its ``section``."""
    return argument("case", metavar="CASE", help=f"case file (TOML) with a section [{section}]")


CASE = argument("case", nargs="?", metavar="CASE", help="case file (TOML); the built-in one if left out")
SET = argument(
    "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change one value; may be repeated"
)
OUT = argument("--out", type=Path, metavar="DIR", help="output folder; one in runs/ if left out")
FORCE = argument("--force", action="store_true", help="begin anew, and replace the results in the output folder")
RESUME = argument("--resume", action="store_true", help="go on with what is in the output folder, nothing else")

QUIET = argument("--quiet", action="store_true", help="tell warnings and errors alone")
VERBOSE = argument("--verbose", action="store_true", help="tell every phase and all statistics")
LOG = argument("--log", type=Path, metavar="FILE", help="add what is told to FILE, with the time")

OF_STUDIES = SET, OUT, FORCE, RESUME  # besides the case
OF_EVERY_VERB = QUIET, VERBOSE, LOG
