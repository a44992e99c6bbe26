"""Arguments that several verbs accept. The module of a verb declares its other arguments."""

from pathlib import Path
from typing import Any, NamedTuple


class Argument(NamedTuple):
    """An argument of a verb: its name or flag, and the keywords of ``argparse.ArgumentParser.add_argument``."""

    flag: str
    keywords: dict[str, Any]


def argument(flag: str, **keywords: Any) -> Argument:
    """Return the argument ``flag`` with these keywords of ``add_argument``."""
    return Argument(flag, keywords)


def case_with(section: str) -> Argument:
    """Return the argument CASE of a verb whose case must have a ``section``, so that there is no built-in one."""
    return argument("case", metavar="CASE", help=f"case file (TOML) with a section [{section}]")


def output_folder(default: str) -> Argument:
    """Return the argument --out of a verb that writes its results to the folder ``default`` if no other is named."""
    return argument("--out", type=Path, metavar="DIR", help=f"output folder; default: {default}")


CASE = argument("case", nargs="?", metavar="CASE", help="case file (TOML); default: the built-in case")
SET = argument(
    "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change one value; may be repeated"
)
OUT = output_folder("runs/NAME of a run, runs/NAME-VERB of another verb, with the name of the case")
FORCE = argument(
    "--force", action="store_true", help="start again from the beginning and replace the results in the output folder"
)
RESUME = argument("--resume", action="store_true", help="only continue existing results in the output folder")

QUIET = argument("--quiet", action="store_true", help="print only warnings and errors")
VERBOSE = argument("--verbose", action="store_true", help="print every phase and all statistics")
LOG = argument("--log", type=Path, metavar="FILE", help="append all messages to FILE, with the time")

# Arguments of all verbs that compute results of a case, after the case itself.
STUDY_ARGUMENTS = SET, OUT, FORCE, RESUME
# Arguments of every verb.
COMMON_ARGUMENTS = QUIET, VERBOSE, LOG
