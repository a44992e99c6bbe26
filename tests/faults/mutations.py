"""Case files that are damaged at random, from a seed, and read in this process as ``validate`` reads them.

``mutations(seed)`` yields files without end; ``judge`` reads one file and returns a verdict. The campaign and a short
test use both.
"""

from __future__ import annotations

import copy
import random
import signal
import time
import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import tomli_w
from pydantic import BaseModel

from vipetsc.case import Case, CaseError, CaseFile
from vipetsc.case.parts import with_located
from vipetsc.case.verb_cases import SECTIONS, load_every
from vipetsc.cli.verbs.verb_list import verb_of
from vipetsc.dynamics import simulate
from vipetsc.dynamics.options import check_options
from vipetsc.io.store import RunMemory
from vipetsc.parallel import StopRequest

EXAMPLES = Path(__file__).parents[2] / "vipetsc" / "examples"
# Values that some key may not take: zero, negative, not finite, too large or small, of another type, or too many.
HOSTILE: list[Any] = [
    0, 1, 2, -1, 0.0, -1.0, 0.5, 1.5, float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 1e-320, 1e-300, 1e300,
    1e17, 1e-17, 10**9, 10**12, 10**30, -(10**30), 10**400, True, "", " ", "pi", "0pi", "1e9", "foo", "traverse",
    "na\u00efve \u202e\u221e", "\u0000", "../..", [], [[]], [0], [1, 1], [1, 2, 3], [1e-3], ["velocity", "velocity"],
    [float("nan")], list(range(1, 400)), {}, {"a": 1}, {"first": 1, "count": 10**9}, {"first": 1e-3, "last": 1e-320},
    {"first": 1, "last": 10**9, "count": 5}, {"first": 5, "count": 3, "spacing": 10**9}, [{"start": 1, "end": 9}],
    {"log": [1.0, 100.0], "count": 3}, {"linear": [0, 1], "count": 10**9}, {"log": [0, 0], "count": 2},
]  # fmt: skip
# Options of PETSc to put into cases, with some valid and some invalid values.
PETSC: dict[str, tuple[Any, ...]] = {
    "ts_rk_type": ("5dp", "8vr", "3bs", "1fe", "magic"), "ts_adapt_type": ("basic", "none", "dsp", "glee"),
    "ts_adapt_clip": ("0.1,2", "2", "0,0"), "ts_dt": ("1e-6", "0", "-1"), "ts_max_steps": ("0", "5"), "ts_rtol": ("1",),
    "ts_type": ("rk", "euler"), "ts_max_time": ("1e-3",), "ts_adapt_wnormtype": ("2", "infinity"), "ksp_type": ("cg",),
    "ts_adapt_safety": ("0.9", "7"), "ts_adapt_dt_max": ("1e-5",), "log_view": ("",), "snes_rtol": (1e-3,),
}  # fmt: skip
# A case with a cell of its own, which no example has.
OWN: dict[str, Any] = {
    "lattice": {
        "cells": 20,
        "cell": {
            "masses": [0.01, 0.02],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 9e3, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 9e3},
            ],
            "contact": [1, 2],
        },
    },
    "contacts": {"sites": [5], "clearance": 1e-4, "stiffness": 1e6},
    "drive": {"frequency": 300.0},
    "time": {"end": 0.2},
}
# The keys and list positions that lead to a value.
KeyPath = tuple[Any, ...]


@dataclass(frozen=True)
class Mutation:
    """A damaged case file: its ``text``, the name ``parent`` of the original case, and the ``changes`` in words."""

    parent: str
    changes: tuple[str, ...]
    text: bytes


@dataclass(frozen=True)
class Verdict:
    """The outcome of reading a file: ``cases`` if it is valid, the ``refusal`` or the ``defect``; CPU ``seconds``."""

    cases: tuple[CaseFile, ...] = ()
    refusal: str = ""
    defect: str = ""
    seconds: float = 0.0


def parents() -> dict[str, dict[str, Any]]:
    """Return the tables of the original cases, by name."""
    files = {}
    for path in sorted(EXAMPLES.glob("*.toml")):
        # A damaged file is in another folder: with relative paths of its modules it would always be refused.
        files[path.stem] = with_located(tomllib.loads(path.read_text(encoding="utf-8")), EXAMPLES)
    return {"builtin": copy.deepcopy(Case.builtin_table), "own": OWN} | files


def known_keys() -> dict[KeyPath, list[Any]]:
    """Return the path of every key of every section, with its values if these are a list of choices."""
    found: dict[KeyPath, list[Any]] = {}
    for section, table in SECTIONS.items():
        _collect(table, (section,), found)
    return found | {("petsc", name): list(values) for name, values in PETSC.items()}


def _collect(annotation: Any, path: KeyPath, found: dict[KeyPath, list[Any]]) -> None:
    """Add the keys of an ``annotation`` at ``path``, and of tables within it, to ``found``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        for name, field in annotation.model_fields.items():
            # A key may be a word that Python reserves, such as lambda, and have an alias.
            _collect(field.annotation, (*path, field.alias or name), found)
        return

    choices = found.setdefault(path, [])
    if get_origin(annotation) is Literal:
        choices += get_args(annotation)
    for argument in get_args(annotation):
        if get_origin(annotation) is not Literal:
            _collect(argument, path, found)


def mutations(seed: int, without: tuple[str, ...] = (), mild: bool = False) -> Iterator[Mutation]:
    """Yield damaged case files without end, from all parents except those in ``without``.

    The same ``seed`` yields the same files. ``mild`` asks for few changes, of kinds that often leave a valid case.
    """
    rng = random.Random(seed)
    keys = known_keys()
    sources = {name: table for name, table in parents().items() if name not in without}
    names = sorted(sources)
    # A kind of change that is listed twice is chosen twice as often.
    counts = (1, 1, 2) if mild else (1, 1, 1, 2, 2, 3, 5)
    kinds = (_scale, _put) if mild else (_replace, _replace, _scale, _remove, _misspell, _lists, _put, _put)

    while True:
        parent = rng.choice(names)
        table = copy.deepcopy(sources[parent])
        changes = []
        for _ in range(rng.choice(counts)):
            change = rng.choice(kinds)
            changes.append(change(rng, table, keys))

        try:
            text = tomli_w.dumps(table).encode("utf-8", "surrogatepass")
        except (ValueError, TypeError):
            # tomli_w refuses some numbers and keys.
            continue

        if rng.random() < 0.1 and not mild:
            text, change_of_text = _spoil_text(rng, text)
            changes.append(change_of_text)
        yield Mutation(parent, tuple(changes), text)


def _places(node: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Yield the path of every value, sections and elements of lists included."""
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(node, dict):
        items = node.items()
    elif isinstance(node, list):
        items = enumerate(node)
    for key, value in items:
        yield (*path, key)
        yield from _places(value, (*path, key))


def _at(table: Any, path: KeyPath) -> Any:
    """Return the value at ``path`` of a table."""
    for key in path:
        table = table[key]
    return table


def _choose(rng: random.Random, table: Any, wanted: Callable[[Any], bool] = lambda value: True) -> KeyPath | None:
    """Return the path of a random value for which ``wanted`` is true, None if there is none."""
    places = [path for path in _places(table) if wanted(_at(table, path))]
    return rng.choice(places) if places else None


def _replace(rng: random.Random, table: Any, keys: Any) -> str:
    """Replace a value by a hostile one; returns the change in words, as do the functions below."""
    path = _choose(rng, table)
    if path is None:
        return "nothing to replace"
    value = copy.deepcopy(rng.choice(HOSTILE))
    _at(table, path[:-1])[path[-1]] = value
    return f"{path} = {value!r:.60}"


def _scale(rng: random.Random, table: Any, keys: Any) -> str:
    """Multiply a number by a factor."""
    # ``isinstance`` would take a bool for an int.
    path = _choose(rng, table, lambda value: type(value) in (int, float))
    if path is None:
        return "nothing to scale"
    factor = rng.choice((-1, 0.5, 2, 10, 100, 1e3, 1e6, 1e12, 0.1, 1e-3, 1e-6, 1e-12, 1e40, 1e-40))
    old = _at(table, path)
    # An integer beyond the largest float cannot be multiplied by a float.
    new = type(old)(old * factor) if abs(old) < 1e300 else old
    _at(table, path[:-1])[path[-1]] = new
    return f"{path} = {new!r:.60}"


def _remove(rng: random.Random, table: Any, keys: Any) -> str:
    """Remove a key or an element of a list."""
    path = _choose(rng, table)
    if path is None:
        return "nothing to remove"
    del _at(table, path[:-1])[path[-1]]
    return f"del {path}"


def _misspell(rng: random.Random, table: Any, keys: Any) -> str:
    """Change the name of a key."""
    path = _choose(rng, table)
    if path is None or not isinstance(path[-1], str):
        return "nothing to misspell"

    section = _at(table, path[:-1])
    # The last two are names of Python and of pydantic.
    name = rng.choice(
        (path[-1][:-1], path[-1] + "s", path[-1].upper(), path[-1] + ".x", "", "ключ", "self", "model_config")
    )
    section[name] = section.pop(path[-1])
    return f"{path} -> {name!r}"


def _lists(rng: random.Random, table: Any, keys: Any) -> str:
    """Lengthen, shorten, empty or nest a list."""
    path = _choose(rng, table, lambda value: isinstance(value, list))
    if path is None:
        return "no list"
    values = _at(table, path)
    what = rng.choice(("double", "cut", "empty", "mix", "nest"))

    if what == "double":
        values += copy.deepcopy(values)
    elif what == "cut" and values:
        values.pop(rng.randrange(len(values)))
    elif what == "empty":
        values.clear()
    elif what == "mix":
        values.append(copy.deepcopy(rng.choice(HOSTILE)))
    else:
        values[:] = [copy.deepcopy(values)]
    return f"{what} {path}"


def _put(rng: random.Random, table: Any, keys: dict[KeyPath, list[Any]]) -> str:
    """Add a key of any section, or of a sweep, with one of its choices, a plausible number or a hostile value."""
    path = rng.choice(sorted(keys))
    numbers = (1, 2, 3, 5, 40, 0.3, 0.9, 1e-3, 1e4, [1], [1, 2], [2, 1], [1.0, 2.0], True)
    plausible = rng.random() < 0.6
    value = rng.choice(keys[path] or numbers if plausible else HOSTILE)
    if rng.random() < 0.15:
        path = ("sweep", *path)
        if not isinstance(value, list):
            value = [value, value]

    # If another change has removed the section, the key is not added.
    section = table
    for key in path[:-1]:
        section = section.setdefault(key, {}) if isinstance(section, dict) else section
    if isinstance(section, dict):
        section[path[-1]] = copy.deepcopy(value)
    return f"{path} := {value!r:.60}"


def _spoil_text(rng: random.Random, text: bytes) -> tuple[bytes, str]:
    """Return the text of a file with a damage that TOML may refuse, and the damage in words."""
    lines = text.splitlines(keepends=True) or [b"\n"]
    i = rng.randrange(len(lines))
    what = rng.choice(("BOM", "twice", "cut", "bytes", "brackets", "digits", "crlf"))

    if what == "BOM":
        return b"\xef\xbb\xbf" + text, what
    if what == "twice":
        return b"".join([*lines[: i + 1], lines[i], *lines[i + 1 :]]), what
    if what == "cut":
        return text[: rng.randrange(len(text) + 1)], what
    if what == "bytes":
        place = rng.randrange(len(text) + 1)
        return text[:place] + bytes(rng.randrange(256) for _ in range(3)) + text[place:], what
    if what == "brackets":
        return text + b"\nx = " + b"[" * 3000, what
    if what == "digits":
        return text + b"\n[drive]\namplitude = " + b"9" * 5000 + b"\n", what
    return text.replace(b"\n", b"\r\n"), what


@contextmanager
def limit(seconds: int) -> Iterator[None]:
    """Raise TimeoutError in the block after ``seconds`` of this process's CPU time, or 10 times as much wall time."""

    # A process that only waits uses no CPU time: the clock ends it.
    def expire(number: int, frame: Any) -> None:
        raise TimeoutError(f"longer than {seconds} s")

    earlier = {number: signal.signal(number, expire) for number in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.alarm(10 * seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        for number, handler in earlier.items():
            signal.signal(number, handler)


def judge(mutation: Mutation, path: Path, seconds: int = 20) -> Verdict:
    """Read ``mutation`` from ``path`` as ``validate`` does; anything but cases or a CaseError is a defect."""
    path.write_bytes(mutation.text)
    begin = time.process_time()
    try:
        with limit(seconds):
            cases = load_every(path)
            check_options(cases[0])
            for case in cases:
                verb_of(case).table(case, 1)
                case.warnings()
                # Texts are compared, because a NaN differs from itself.
                assert type(case).from_toml(case.to_toml()).to_toml() == case.to_toml()
    except CaseError as error:
        return Verdict(refusal=str(error), seconds=time.process_time() - begin)
    except Exception as error:
        return Verdict(defect=f"{type(error).__name__}: {error}", seconds=time.process_time() - begin)
    return Verdict(tuple(cases), seconds=time.process_time() - begin)


class Deadline(StopRequest):
    """A request to stop after ``seconds``: an exception from a signal would leave PETSc in the middle of a step."""

    def __init__(self, seconds: float) -> None:
        self.end = time.monotonic() + seconds

    @property
    def requested(self) -> bool:  # type: ignore[override]
        """Return whether the time is over."""
        return time.monotonic() > self.end


def run_shortly(case: Case, seconds: float = 20, samples: int = 100) -> str:
    """Simulate the first ``samples`` samples of ``case`` in memory; return the defect, or "" if there is none.

    A run without a defect ends with a sentence or is refused. Cases of more than 2000 cells are left out, and runs that
    take longer than ``seconds`` are stopped.
    """
    if case.lattice.cells > 2000:
        return ""
    model = case.model()
    try:
        shortened = case.varied(time={"end": min(model.end, samples * model.sample_interval)})
        result = simulate(shortened, RunMemory(), stop=Deadline(seconds))
    except CaseError:
        return ""
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "" if result.sentence else "no sentence"
