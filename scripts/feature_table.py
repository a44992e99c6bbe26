"""Write the chapter of the manual with a table of which verb accepts which feature of a case: ``manual/features.md``.

    python scripts/feature_table.py

Every entry follows from a check of a small case. A verb accepts a feature if its case with this feature is valid, and
if the checks that come after reading it (of an engine, of linear modes) accept it too. Otherwise the entry is the
message that refuses it.
"""

import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from vipetsc.case import Case, CaseError, CaseFile, LawCase, NnmCase, Sweep
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.predict import PredictCase
from vipetsc.case.reading import Table

ROOT = Path(__file__).parents[1]
CHAPTER = ROOT / "vipetsc" / "manual" / "features.md"
YES = "yes"
UNREAD = "-"  # the verb reads no section that has the feature
SEPARATOR = "\n"  # between the sentences that refuse one feature

# A chain of masses on which resonators sit: pass bands 0-1468 and 1936-3405 rad/s.
HOST_SPRING = {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}
RESONATOR_SPRING = {"start": 1, "end": 2, "stiffness": 5e3}
BASE: Table = {
    "name": "feature",
    "lattice": {"cells": 24, "cell": {"masses": [4e-3, 2e-3], "springs": [HOST_SPRING, RESONATOR_SPRING]}},
    "contacts": {"law": "hertz", "stiffness": 1e7, "sites": [12, 14], "clearance": 1e-4, "restitution": 0.7},
}
DRIVEN: Table = {
    "drive": {"amplitude": 3.0, "frequency": 1000.0, "cycles": 3, "cell": 4},
    "time": {"end": 0.05, "sample_interval": 2e-4},
    "output": {"figures": False},
}
# Two masses between walls, the second one with a stop.
OWN: Table = {
    "masses": [1.0, 1.0],
    "springs": [{"start": 0, "end": 1, "stiffness": 1.0}, {"start": 1, "end": 2, "stiffness": 1.0}],
    "contacts": [{"host": 1, "resonator": 2, "clearance": 0.1}],
}


@dataclass(frozen=True)
class Feature:
    """A feature of cases: its ``name``, and the ``changes`` of the case ``BASE`` after which it has the feature.

    ``system_changes`` are the changes after which the system of [nnm.own] has it, None if such a system cannot have it.
    ``scaled`` are further changes for single columns, by their headings: with the feature the case of that column needs
    numbers of another size, or would take long.
    """

    name: str
    changes: Table
    system_changes: Table | None = None
    scaled: Table = field(default_factory=dict)


@dataclass(frozen=True)
class Column:
    """A column of the table, a verb in one of its forms: its ``heading``, the ``kind`` of its case, and its sections.

    ``sections`` are the changes of ``BASE`` that the verb needs. ``refusal`` checks a valid case further, and returns
    the reason for which it is refused, or an empty text. ``is_system`` is true for the system of [nnm.own].
    """

    heading: str
    kind: type[CaseFile]
    sections: Table
    refusal: Callable[[Any], str] = field(default=lambda case: "")
    is_system: bool = False

    def table(self, feature: Feature) -> Table | None:
        """Return the table of a case file with ``feature``; None if the verb reads no section that has it."""
        changes = feature.system_changes if self.is_system else feature.changes
        if changes is None:
            return None

        if not changes.keys() <= {*self.kind.keywords(), "plugins"}:
            return None
        # Changes are merged one after the other: None in a later one removes a key that an earlier one has put in.
        return merged(merged(merged(BASE, self.sections), changes), feature.scaled.get(self.heading, {}))

    def answer(self, feature: Feature) -> str:
        """Return ``YES``, ``UNREAD``, or the sentence that refuses ``feature``."""
        table = self.table(feature)
        if table is None:
            return UNREAD
        try:
            case = self.kind.from_table(table)
            if isinstance(case, Sweep):
                case.members()
        except CaseError as error:
            return _sentences(error)
        return self.refusal(case) or YES


def merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> Table:
    """Return a copy of ``table`` with the ``changes``, which go into tables within tables too; None removes a key."""
    result = dict(table)
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(result.get(key), dict):
            value = merged(result[key], value)
        result[key] = value
    return {key: value for key, value in result.items() if value is not None}


def _sentences(error: CaseError) -> str:
    """Return the remedies of ``error``, each once, without the keys and the values of the small case."""
    return SEPARATOR.join(dict.fromkeys(problem.remedy for problem in error.problems))


def _propagator_refusal(case: Case) -> str:
    """Return why the propagator does not suit ``case``."""
    from vipetsc.dynamics.propagator.step_choice import refusal

    return refusal(case.model()) or ""


def _modes_refusal(case: Case) -> str:
    """Return why linear modes of ``case`` are not computed."""
    from vipetsc.studies.linear_modes import check_modes

    try:
        check_modes(case, 1, 0.0)
    except CaseError as error:
        return _sentences(error)
    return ""


QUIET: Table = {"output": {"figures": False}}
NNM = {"modes": [1], "points": 2, "energy": [0.0, 1.0]}
# With the default bound on what is left out, a motion would have hundreds of harmonics.
FEW_HARMONICS = {"harmonics": 41, "truncation": 1e-3}
TWELVE_CELLS: Table = {"lattice": {"cells": 12}, "contacts": {"sites": [6, 8]}}
BREATHER = {"start_frequency": [4500.0], "start_sites": [1]}
STEPS = {"points": 4, "harmonics": 5, "first_step": 0.2, "largest_step": 0.3}
# With more harmonics stability changes on the way, and to locate that takes most of the time.
WAVES = {"range": [0.9, 2.0], "harmonics": 3}
FORCE = {"source": "force", "infinite": False, "range": [0.44, 1.0]}
FEW_RUNS = {"largest": 2.0, "tolerance": 0.9, "finest": 0.5, "samples": 1}
PREDICT = {"predict": {"amplitudes": [2.0], "points": 16}}
# About as long as the burst takes to the sites: the table asks whether a run is accepted, not what comes out.
SHORT = {"time": {"end": 0.03, "sample_interval": 5e-4, "rtol": 1e-6}}
# Well below the edge of the band, near which waves are slow: the ring of a law then has 109 cells, not 1911.
FAST = {"drive": {"frequency": 800.0}}
# One run a design.
SEARCH = {"budget": 2, "curve": [3.0], "variables": {"profile": [1e-5, 1e-3]}, "objective": [{"measure": "entropy"}]}
# The record of an example, which is of another lattice: the table asks whether a fit is accepted, not what comes out.
# With so much noise every misfit is explained, so that the fit ends soon.
RECORD = {
    "file": str(files("vipetsc") / "examples" / "identify.csv"),
    "time": 1,
    "end": 0.02,
    "sensors": [{"quantity": "velocity", "column": 2, "cell": 4, "noise": 10.0}],
}
AMPLITUDE = {"quantity": "amplitude", "bounds": [0.1, 100.0]}
IDENTIFY = {"records": [RECORD], "unknowns": [AMPLITUDE], "impacts": 1000, "growth": 100, "steps": 1, "profile": 0}
COLUMNS: tuple[Column, ...] = (
    Column("run", Case, DRIVEN),
    Column("propagator", Case, merged(DRIVEN, {"time": {"engine": "propagator"}}), _propagator_refusal),
    Column("sweep", Sweep, merged(DRIVEN, {"sweep": {"measures": ["motion"], "time": {"rtol": [1e-8]}}} | SHORT)),
    Column("optimise", OptimiseCase, merged(DRIVEN, {"optimise": SEARCH} | SHORT)),
    Column("identify", IdentifyCase, merged(DRIVEN, {"identify": IDENTIFY})),
    Column("bands", Case, DRIVEN, _modes_refusal),
    Column("law", LawCase, merged(merged(DRIVEN, {"law": FEW_RUNS} | SHORT), FAST)),
    Column("predict", PredictCase, merged(merged(DRIVEN, PREDICT | SHORT), FAST)),
    Column("nfrc", NfrcCase, merged(DRIVEN, {"nfrc": STEPS | FORCE})),
    Column("wave", NfrcCase, merged(DRIVEN, {"nfrc": STEPS | WAVES})),
    Column("reduced", NnmCase, QUIET | {"nnm": NNM | {"system": "reduced", "modes": [2]}}),
    Column("chain", NnmCase, QUIET | TWELVE_CELLS | {"nnm": NNM | {"system": "chain", "modes": [13]}}),
    Column("own", NnmCase, QUIET | {"nnm": NNM | {"system": "own", "own": OWN}}, is_system=True),
    Column("condensed", NnmCase, QUIET | {"nnm": NNM | BREATHER | FEW_HARMONICS | {"system": "condensed"}}),
)
"""The verbs that read a case, each in its forms."""


def _lattice(**changes: Any) -> Table:
    return {"lattice": changes}


def _contacts(**changes: Any) -> Table:
    return {"contacts": changes}


def _grains(cell: Table) -> Table:
    """Return changes after which contacts alone join the cells, and are pressed at rest."""
    joining = {"pair": [1, 1], "next_cell": True, "sites": _all_but_the_last(BASE)}
    pressed = {"side": "minus", "clearance": 0.0, "precompression": 2e-4, "restitution": 1.0}
    return _lattice(cell=cell, ends="free") | _contacts(**joining, **pressed)


def _all_but_the_last(table: Table) -> list[int]:
    """Return the cells of a lattice that have a next cell."""
    return list(range(1, table["lattice"]["cells"]))


def _own_contacts(*contacts: tuple[int, float]) -> Table:
    """Return changes that give the second mass of [nnm.own] ``contacts``, pairs of a host and a clearance in m."""
    pairs = [{"host": host, "resonator": 2, "clearance": clearance} for host, clearance in contacts]
    return {"nnm": {"own": {"contacts": pairs}}}


def _drive(**changes: Any) -> Table:
    # Without the keys of the burst in ``DRIVEN``, which another waveform may not have.
    return {"drive": {"cycles": None, "frequency": None, **changes}}


def _initial(**changes: Any) -> Table:
    return {"initial": changes}


FEW_SPRINGS: Table = {
    "lattice": {"cells": 4},
    "contacts": {"sites": [2, 3]},
    "nnm": {"points": 1, "harmonics": 21, "truncation": 1e-3},
}
SHORT_LATTICE: Table = TWELVE_CELLS | {"nfrc": {"points": 2, "harmonics": 3}}
TWELVE_GRAINS: Table = _contacts(sites=_all_but_the_last(TWELVE_CELLS))
# A pressed chain of equal grains softens: no breather begins at the upper edge of its band, 14,565 rad/s. A light grain
# has a mode above it, at 16,818 rad/s, in which its two contacts move against each other; its breathers lie below that.
LIGHT_GRAIN: Table = {
    "lattice": {"cells": 8, "profiles": {"masses[1]": {"cells": [4], "value": 2e-3}}},
    "contacts": {"sites": [1, 2, 3, 4, 5, 6, 7]},
    "nnm": {"start_frequency": [16500.0], "start_sites": [3, -4]},
}
IN_CELL_6 = {"lattice": {"cells": 12, "profiles": {"springs[2].cubic": {"cells": [6], "value": 1e9}}}}
IN_CELL_2 = {"lattice": {"cells": 4, "profiles": {"springs[2].cubic": {"cells": [2], "value": 1e9}}}}
SECOND_DRIVE = {"amplitude": 0.5, "frequency": 900.0, "cycles": 3, "cell": 6}
CUBIC_CELL = {"springs": [HOST_SPRING, RESONATOR_SPRING | {"cubic": 1e9}]}
MEASURED = {"time": [0.0, 1e-3, 2e-3, 3e-3, 4e-3], "value": [0.0, 1.0, -1.0, 0.5, 0.0]}
RUBBER = {"plugins": {"modules": [str(files("vipetsc") / "examples" / "own_law.py")]}} | _contacts(
    law="rubber-stop", parameters={"b": 1e7}
)
FEATURES: tuple[Feature, ...] = (
    Feature(
        "dashpots",
        _lattice(damping={"mass": 1.0}),
        {"nnm": {"own": {"dashpots": [{"start": 0, "end": 2, "damping": 0.1}]}}},
    ),
    Feature("loss by bands", _lattice(damping={"loss": {"1": 0.01}})),
    Feature(
        "nonlinear springs",
        _lattice(cell=CUBIC_CELL),
        {"nnm": {"own": {"smooth": [{"start": 0, "end": 1, "cubic": 0.5}]}}},
        # Each of these springs has unknown harmonics.
        scaled={"nfrc": SHORT_LATTICE, "condensed": FEW_SPRINGS},
    ),
    Feature(
        "nonlinear springs in few cells",
        _lattice(profiles={"springs[2].cubic": {"cells": [6, 13], "value": 1e9}}),
        scaled={"nfrc": SHORT_LATTICE | IN_CELL_6, "chain": IN_CELL_6, "condensed": FEW_SPRINGS | IN_CELL_2},
    ),
    Feature("profiles of cells", _lattice(profiles={"masses[1]": {"first": 4e-3, "last": 4.1e-3}})),
    Feature("disorder of cells", {"disorder": {"cells": {"masses[1]": {"relative": 0.01}}}}),
    Feature("disorder of sites", {"disorder": {"clearance": {"relative": 0.01}}}),
    Feature("absorbing ends", _lattice(absorbing={"cells": 9, "strength": 1.0})),
    Feature("free ends", _lattice(ends="free")),
    Feature("ring", _lattice(ends="periodic")),
    Feature(
        "strip of the plane",
        _lattice(cell=None, strip={"rows": 2, "kind": "triangular", "mass": 4e-3, "stiffness": 1e4}),
    ),
    Feature(
        "one-sided stops",
        _contacts(side="plus"),
        _contacts(side="plus"),
        # Above the bands the mean of its force moves such a site away from its stop.
        scaled={"condensed": {"nnm": {"start_frequency": [1500.0]}}},
    ),
    Feature("two clearances", _contacts(clearance_minus=2e-4), _contacts(clearance_minus=2e-4)),
    Feature("unequal clearances", _contacts(clearance=[1e-4, 2e-4]), _own_contacts((1, 0.1), (0, 0.2))),
    Feature(
        "touching stops",
        _contacts(clearance=0.0, side="plus", restitution=1.0),
        merged(_own_contacts((1, 0.0)), _contacts(side="plus", restitution=1.0)),
    ),
    Feature(
        "preload",
        _contacts(precompression=2e-4, side="plus", restitution=1.0),
        # Not so deep that the two masses move as one.
        merged(_own_contacts((1, 0.0)), _contacts(precompression=1e-6, side="plus", restitution=1.0)),
    ),
    Feature(
        "a law for each site", _contacts(each={"law": ["bilinear", "hertz"], "stiffness": [1e5, 1e7]}, stiffness=None)
    ),
    Feature("restitutions of sites", _contacts(each={"restitution": [0.9, 0.7]})),
    Feature("law of a plugin", RUBBER, RUBBER),
    Feature(
        "rigid stops",
        _contacts(law="rigid", stiffness=None),
        _contacts(law="rigid", stiffness=None),
        # Free motions have no loss at impacts.
        dict.fromkeys(("reduced", "chain", "own", "condensed"), _contacts(restitution=1.0)),
    ),
    Feature("contacts to ground", _contacts(pair=[0, 2]), _own_contacts((0, 0.2))),
    Feature("contacts between cells", _contacts(pair=[1, 1], next_cell=True)),
    Feature("several in a cell", _contacts(sites=[12, 12], each={"pair": [[1, 2], [0, 2]]})),
    Feature("burst", {"drive": {}}),
    Feature("harmonic", _drive(waveform="harmonic", frequency=1000.0)),
    Feature(
        "chirp",
        _drive(waveform="chirp", frequency=1000.0, bandwidth=200.0, duration=0.02),
        # In 0.02 s less than 95 % of its energy is within 30 % of its main frequency, which `predict` refuses.
        scaled={"predict": {"drive": {"duration": 0.05}}},
    ),
    Feature("impulse", _drive(waveform="impulse", duration=1e-3)),
    Feature("step", _drive(waveform="step", ramp=5e-3)),
    Feature("measured samples", _drive(waveform="samples", samples=MEASURED)),
    Feature(
        "moved wall",
        {"drive": {"end": "left", "cell": None, "amplitude": 1e-4}},
        scaled={"nfrc": {"nfrc": {"range": [1e-6, 2e-5]}}, "predict": {"predict": {"amplitudes": [1e-4]}}},
    ),
    Feature(
        "moved wall, dashpots",
        {"lattice": {"damping": {"stiffness": 1e-7}}, "drive": {"end": "left", "cell": None, "amplitude": 1e-4}},
        scaled={"nfrc": {"nfrc": {"range": [1e-6, 2e-5]}}, "predict": {"predict": {"amplitudes": [1e-4]}}},
    ),
    Feature(
        "several drives",
        {"drive": {"more": [SECOND_DRIVE]}},
        # All have the period of the steady state; against the first force, so that the range begins without contact.
        scaled={"nfrc": {"drive": {"more": [SECOND_DRIVE | {"frequency": 1000.0, "amplitude": -0.5}]}}},
    ),
    Feature("mode at t = 0", _initial(kind="mode", number=3, amplitude=1e-5)),
    Feature("packet at t = 0", _initial(kind="packet", band=1, wavenumber=1.0, cell=12, width=2.0, amplitude=1e-5)),
    Feature("struck masses", _initial(kind="velocity", cell=5, velocity=0.1)),
    Feature(
        "grains",
        _grains({"masses": [4e-3], "springs": []}),
        # There are as many modes as grains.
        scaled={"chain": TWELVE_GRAINS | {"nnm": {"modes": [2]}}, "condensed": LIGHT_GRAIN},
    ),
    Feature(
        "grains with resonators",
        _grains({"springs": [RESONATOR_SPRING]}),
        scaled={"chain": TWELVE_GRAINS, "condensed": LIGHT_GRAIN},
    ),
)
"""The features of a case, in the order of the chapter."""


@cache
def answers() -> Mapping[str, Sequence[str]]:
    """Return the answer of each column to each feature, by the feature's name."""
    return {feature.name: [column.answer(feature) for column in COLUMNS] for feature in FEATURES}


def chapter() -> str:
    """Return the manual's chapter: a table of the refusals by feature, and the reasons below it."""
    rows = answers()
    refused = [answer for row in rows.values() for answer in row if answer not in (YES, UNREAD)]
    reasons = list(dict.fromkeys(reason for answer in refused for reason in answer.split(SEPARATOR)))
    return "\n".join([*_introduction(rows), *_table(rows, reasons), "", *_reasons(reasons), ""])


def _introduction(rows: Mapping[str, Sequence[str]]) -> Iterator[str]:
    accepted = [name for name, row in rows.items() if set(row) <= {YES, UNREAD}]
    text = f"""
        The table lists which verbs refuse a feature of a case; all other verbs accept it. A number stands for the
        message below the table. A message with *not yet* gives no reason of physics: the verb could accept the feature,
        but is not written for it. Every verb accepts {", ".join(accepted[:-1])} and {accepted[-1]}.

        `propagator` is `run` by that engine (a run that it refuses goes on with `ts`), `bands` is `bands --modes`
        (linear modes, without dashpots), `nfrc` has a force or a moved wall, `wave` is `nfrc` with an incident wave,
        and the last four are the systems of `nnm`, of which `condensed` has the breathers. `nnm` reads no drive and no
        initial motion, and its system `own` neither the lattice nor the sites. `plot` and `export` accept the run of
        every feature.
    """
    yield "# Verbs and features"
    for paragraph in textwrap.dedent(text).strip().split("\n\n"):
        yield ""
        yield textwrap.fill(paragraph.replace("\n", " "), 120, break_on_hyphens=False)
    yield ""


def _table(rows: Mapping[str, Sequence[str]], reasons: Sequence[str]) -> Iterator[str]:
    """Yield the lines of the table, whose entries refer to the ``reasons`` by numbers."""
    number = {reason: str(place) for place, reason in enumerate(reasons, 1)}
    yield "| feature | refused by |"
    yield "|---|---|"
    for name, row in rows.items():
        columns: dict[str, list[str]] = {}
        for column, answer in zip(COLUMNS, row, strict=True):
            if answer not in (YES, UNREAD):
                numbers = ", ".join(number[reason] for reason in answer.split(SEPARATOR))
                columns.setdefault(numbers, []).append(f"`{column.heading}`")
        if columns:
            refused = [f"{', '.join(headings)} ({numbers})" for numbers, headings in columns.items()]
            yield f"| {name} | {'; '.join(refused)} |"


def _reasons(reasons: Sequence[str]) -> Iterator[str]:
    """Yield the numbered ``reasons``."""
    for number, reason in enumerate(reasons, 1):
        yield f"{number}. {reason}"


if __name__ == "__main__":
    CHAPTER.write_text(chapter(), encoding="utf-8")
