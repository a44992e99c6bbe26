"""Parts of a user's module: contact laws, dissipation factors, waveforms, measures and figures, by name.

A module of the user calls the functions below; a case that names the module in ``[plugins]`` has its parts:

    from vipetsc import register

    @register.dissipation_factor("herbert-mcwhannell")
    def damping(restitution):
        return 6 * (1 - restitution) / ((2 * restitution - 1) ** 2 + 3)

Each part records the module that registers it and the SHA-256 of its source file, which results carry.
"""

import hashlib
import inspect
import marshal
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any, ClassVar, NamedTuple, TypeVar

# The kinds of parts.
LAW = "law"
DISSIPATION = "dissipation"
WAVEFORM = "waveform"
MEASURE = "measure"
FIGURE = "figure"
NAME = re.compile(r"[A-Za-z][\w-]*")
# Parameters of an elastic law: the compiled record of a site has a field for each, and its functions take so many
# numbers besides x and k.
MOST_PARAMETERS = 4

Function = TypeVar("Function", bound=Callable[..., Any])


class PartError(Exception):
    """A part whose name is taken, or whose function fails or returns what it must not; says which, and where."""


class Parameter(NamedTuple):
    """A number that a case gives to a law or a waveform: its ``unit``, a ``text``, and the values that it may have."""

    unit: str = ""
    text: str = ""
    least: float = -1e50
    most: float = 1e50


@dataclass(frozen=True, kw_only=True, eq=False)
class RegisteredPart:
    """A part that a module registers: its ``name``, the source ``file`` and its ``sha256``.

    ``modules`` are the names of the Python modules that register it: several, if they are copies of one file.
    """

    name: str
    modules: set[str]
    file: str
    sha256: str
    kind: ClassVar[str]


@dataclass(frozen=True, kw_only=True, eq=False)
class LawPart(RegisteredPart):
    """An elastic law: see ``elastic_law``."""

    force: Callable[..., float]
    slope: Callable[..., float]
    energy: Callable[..., float]
    onset_exponent: float
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    kind = LAW


@dataclass(frozen=True, kw_only=True, eq=False)
class DissipationPart(RegisteredPart):
    """A factor of dissipation: see ``dissipation_factor``."""

    function: Callable[[float], float]
    least_restitution: float = 0.0
    kind = DISSIPATION


@dataclass(frozen=True, kw_only=True, eq=False)
class WaveformPart(RegisteredPart):
    """A waveform of a drive: see ``waveform``."""

    function: Callable[..., Any]
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    needs: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    frequency: Callable[..., float] | None = None
    unit: str = "N"
    kind = WAVEFORM


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasurePart(RegisteredPart):
    """A number that is measured of a run: see ``measure``."""

    function: Callable[[Any], float | None]
    unit: str
    text: str
    power: float | None = None
    kind = MEASURE


@dataclass(frozen=True, kw_only=True, eq=False)
class FigurePart(RegisteredPart):
    """A figure: see ``figure``."""

    function: Callable[..., Any]
    source: str = "run"
    kind = FIGURE


PARTS: dict[str, dict[str, RegisteredPart]] = {kind: {} for kind in (LAW, DISSIPATION, WAVEFORM, MEASURE, FIGURE)}
"""The registered parts of each kind, by name."""
_TAKEN: dict[str, set[str]] = {kind: set() for kind in PARTS}


def elastic_law(
    name: str,
    force: Callable[..., float],
    slope: Callable[..., float],
    energy: Callable[..., float],
    *,
    onset_exponent: float,
    parameters: Mapping[str, Parameter] | None = None,
) -> None:
    """Register the elastic law that a case calls ``contacts.law = name``.

    Parameters
    ----------
    name
        Name of the law in case files.
    force, slope, energy
        Functions of the indentation x > 0 in m, the stiffness k, and one number for each of the ``parameters``: f in N,
        df/dx in N/m, the integral of f from 0 to x in J. Numba compiles them; x is one number.
    onset_exponent
        The power of x with which the force begins: 1 of a linear onset, 3/2 of spheres.
    parameters
        Numbers of ``[contacts.parameters]`` that the law takes, by name, in the order of the functions' arguments; at
        most four.

    Raises
    ------
    ValueError
        If the name is taken, or a function takes other arguments.
    """
    taken = dict(parameters or {})
    if len(taken) > MOST_PARAMETERS:
        raise ValueError(f"the law {name!r} has {len(taken)} parameters; at most {MOST_PARAMETERS} can be passed")
    if not onset_exponent >= 1:
        raise ValueError(f"the law {name!r} begins with the power {onset_exponent}; at least 1 is needed")
    for function in (force, slope, energy):
        _check_arguments(function, ("x", "k", *taken), f"of the law {name!r}")

    part = LawPart(
        force=force,
        slope=slope,
        energy=energy,
        onset_exponent=float(onset_exponent),
        parameters=taken,
        **_origin(name, force),
    )
    _add(part)


def dissipation_factor(name: str, *, least_restitution: float = 0.0) -> Callable[[Function], Function]:
    """Register the decorated function as ``contacts.damping = name``.

    It returns the factor c of g = 1 + c w'/w'_minus for a restitution r; ``least_restitution`` is the smallest r that a
    case may give, for a c that grows without bound towards 0. Raises ValueError if the name is taken.
    """

    def add(function: Function) -> Function:
        _check_arguments(function, ("restitution",), f"of the dissipation factor {name!r}")
        _add(DissipationPart(function=function, least_restitution=least_restitution, **_origin(name, function)))
        return function

    return add


def waveform(
    name: str,
    *,
    parameters: Mapping[str, Parameter] | None = None,
    needs: Iterable[str] = (),
    takes: Iterable[str] = (),
    frequency: Callable[..., float] | None = None,
    unit: str = "N",
) -> Callable[[Function], Function]:
    """Register the decorated function as ``drive.waveform = name``.

    The function takes the resolved drive and a number for each of the ``parameters``; it returns a waveform of
    ``vipetsc.lattice.drive``, such as ``sampled`` and ``ramped`` build it.

    Parameters
    ----------
    name
        Name of the waveform in case files.
    parameters
        Numbers of ``[drive.parameters]``, by name, in the order of the function's arguments.
    needs, takes
        Keys of ``[drive]``, of those that shipped waveforms have (``duration``, ``cycles``, ``ramp``, ...), that must
        and may be given.
    frequency
        The main frequency in rad/s, a function of the same arguments. Without one the case gives the drive's frequency,
        wavenumber or band.
    unit
        Unit of the amplitude.

    Raises
    ------
    ValueError
        If the name is taken, or the function takes other arguments.
    """
    taken = dict(parameters or {})

    def add(function: Function) -> Function:
        for called in (function, frequency):
            if called is not None:
                _check_arguments(called, ("drive", *taken), f"of the waveform {name!r}")
        part = WaveformPart(
            function=function,
            parameters=taken,
            needs=tuple(needs),
            takes=tuple(takes),
            frequency=frequency,
            unit=unit,
            **_origin(name, function),
        )
        _add(part)
        return function

    return add


def measure(name: str, *, unit: str, text: str, power: float | None = None) -> Callable[[Function], Function]:
    """Register the decorated function as a measure of runs, which ``run``, ``sweep``, ``optimise`` and ``export`` take.

    It takes a ``vipetsc.spectra.measures.RunRecord`` and returns a number in ``unit``: None where the run cannot have
    that number, NaN where it could have it but has no value. ``text`` describes the measure. Without contact it is
    proportional to the amplitude to the ``power``: sweeps then scale a linear run for members without contact. Raises
    ValueError if the name is taken.
    """

    def add(function: Function) -> Function:
        _check_arguments(function, ("record",), f"of the measure {name!r}")
        _add(MeasurePart(function=function, unit=unit, text=text, power=power, **_origin(name, function)))
        return function

    return add


def figure(name: str, *, source: str = "run") -> Callable[[Function], Function]:
    """Register the decorated function as a figure of runs, which ``vipetsc plot RUN --fig name`` draws.

    It takes the run and its analysis (or None), datasets of xarray, and returns a figure of matplotlib. For another
    ``source`` its arguments are those of ``vipetsc.figures.registry.FigureSpec``. Raises ValueError if the name is
    taken.
    """

    def add(function: Function) -> Function:
        _add(FigurePart(function=function, source=source, **_origin(name, function)))
        return function

    return add


def reserve(kind: str, names: Iterable[str]) -> None:
    """Keep the ``names`` of shipped parts of a ``kind`` from being registered.

    Raises PartError for a name that a module has registered already.
    """
    _TAKEN[kind] |= {*names}
    for name in _TAKEN[kind] & PARTS[kind].keys():
        raise PartError(f"{PARTS[kind][name].file}: there is a {kind} {name!r} of vipetsc already")


def file_digest(file: str) -> str:
    """Return SHA-256 of a source ``file``; empty without one, as for code that is typed in."""
    path = Path(file)
    if not path.is_file():
        return ""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _origin(name: str, function: Callable[..., Any]) -> dict[str, Any]:
    """Return the fields of the part ``name`` on the source of its ``function``; raises ValueError if it is none."""
    plain = _plain(function)
    file = str(plain.__code__.co_filename)
    # Code that is typed in has no file: the hash is that of the function's own text.
    digest = file_digest(file) or hashlib.sha256(_text_of(plain)).hexdigest()
    return {"name": name, "modules": {function.__module__}, "file": file, "sha256": digest}


def _text_of(function: FunctionType) -> bytes:
    """Return the text of a ``function``, or its code where Python keeps no text: at its prompt, and with ``-c``."""
    try:
        return inspect.getsource(function).encode()
    except OSError:
        # Versions of this format above 2 also store how often objects are referred to, which differs between processes.
        return marshal.dumps(function.__code__, 2)


def _plain(function: Callable[..., Any]) -> FunctionType:
    """Return function in Python that numba compiles or a decorator wraps; raises ValueError for what is no function."""
    plain = inspect.unwrap(getattr(function, "py_func", function))
    if not isinstance(plain, FunctionType):
        raise ValueError(f"{function!r} is no function written in Python")
    return plain


def _check_arguments(function: Callable[..., Any], names: tuple[str, ...], what: str) -> None:
    """Raise ValueError for a ``function`` that does not take as many arguments as there are ``names``."""
    plain = _plain(function)
    try:
        inspect.signature(plain).bind(*names)
    except TypeError:
        raise ValueError(f"{plain.__name__} {what} must take ({', '.join(names)})") from None


def _add(part: RegisteredPart) -> None:
    """Enter a ``part`` in ``PARTS``; raises ValueError for a name that is invalid or taken.

    A module that is executed again replaces its parts; a copy of a module, of equal source, adds none.
    """
    if not NAME.fullmatch(part.name):
        raise ValueError(f"{part.name!r} is no name for a {part.kind}: letters, digits, - and _, a letter first")
    if part.name in _TAKEN[part.kind]:
        raise ValueError(f"there is a {part.kind} {part.name!r} of vipetsc already")

    earlier = PARTS[part.kind].get(part.name)
    # In a notebook a cell is executed again and again, each time with another source.
    if earlier is None or earlier.modules == part.modules:
        PARTS[part.kind][part.name] = part
    elif earlier.sha256 == part.sha256:
        earlier.modules.update(part.modules)
    else:
        raise ValueError(f"there is another {part.kind} {part.name!r} in {earlier.file} already")
