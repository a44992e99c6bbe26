"""The verb ``validate``: checks a case for each verb whose section it contains, and prints the resulting numbers."""

import argparse
import tomllib
from typing import TYPE_CHECKING

import numpy as np

from vipetsc.case import Case, CaseFile
from vipetsc.case.disorder import DisorderTable, values_of
from vipetsc.case.parts import parts_in_use
from vipetsc.case.verb_cases import disorder_of, load_every
from vipetsc.cli.arguments import CASE, SET
from vipetsc.cli.messages import echo, first_few, table
from vipetsc.cli.verb import DONE, PlainVerb, Rows
from vipetsc.parallel import StopRequest, on_root

if TYPE_CHECKING:
    from mpi4py import MPI


def validate(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Check a case for every verb whose section it contains, and print the numbers that follow from it."""
    echo(comm, on_root(comm, lambda: report_of(options, comm.size)))
    return DONE


def report_of(options: argparse.Namespace, ranks: int) -> str:
    """Return the rows of all verbs that read the case, and its warnings; raises CaseError. Called on one rank."""
    from vipetsc.cli.verbs.verb_list import verb_of
    from vipetsc.dynamics.plan import check_petsc_options

    cases = load_every(options.case, options.set)
    rows: Rows = []
    warnings: list[str] = []
    for case in cases:
        check_petsc_options(case)
        rows += verb_of(case).table(case, ranks)
        rows += part_rows(case)
        warnings += case.warnings()
    disorder = disorder_of(options.case, options.set, cases)
    if disorder:
        rows += disorder_rows(*disorder)

    # Once each: verbs that have a lattice have the same rows and warnings about it.
    lines = [table([*dict.fromkeys(rows)])]
    lines += [f"warning: {warning}" for warning in dict.fromkeys(warnings)]
    return "\n".join(lines)


def part_rows(case: CaseFile) -> Rows:
    """Return a row for each part, such as a contact law, that a module has registered and the case uses."""
    rows = []
    for plugin, part in parts_in_use(tomllib.loads(case.to_toml())):
        version = ""
        if plugin.version:
            version = f", version {plugin.version}"
        rows.append((part.kind, f"{part.name}, registered by {plugin.name}{version}"))
    return rows


def disorder_rows(disorder: DisorderTable, nominal: Case, drawn: Case) -> Rows:
    """Return a row for each quantity with ``disorder``: its deviation, and the first values that were ``drawn``.

    The values are ratios to those of the ``nominal`` case; those of sites are cells.
    """
    before = values_of(dict(nominal))
    after = values_of(dict(drawn))
    rows = []
    for name, deviation in disorder.quantities().items():
        # Sites move by whole cells. Other quantities scatter about a value, to which the ratio shows the distance.
        if name == "sites":
            values = f"cells {first_few([f'{cell:.5g}' for cell in after[name]])}"
        else:
            # The clearance of a stop that touches is 0 and does not scatter: its ratio is 1.
            ratios = np.ones(len(before[name]))
            np.divide(after[name], before[name], out=ratios, where=np.not_equal(before[name], 0))
            values = f"times {first_few([f'{ratio:.5g}' for ratio in ratios])}"
        rows.append((f"disorder of {name}", f"{deviation}; seed {disorder.seed}: {values}"))
    return rows


VERB = PlainVerb(
    name="validate",
    text="check a case, and print its band edges, frequency, end time, size and cost",
    example="validate runs/examples/three-mass.toml",
    arguments=(CASE, SET),
    function=validate,
    is_answer=True,
    takes_petsc_options=True,
)
