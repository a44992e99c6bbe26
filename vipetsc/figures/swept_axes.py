"""The axes of a sweep as pictures name them: keys by their path in the case, values with units, scales of numbers."""

import tomllib
from fractions import Fraction
from typing import Any, NamedTuple, Self

import numpy as np
import xarray as xr

from vipetsc.case.keys import unit_of
from vipetsc.io.read import axes as axes_of
from vipetsc.wording import key_name, key_words, with_unit

FEW_TOGETHER = 6  # values up to which keys that vary together are categories; of more they are numbers
FRACTION_LIMIT = 36  # largest denominator of a wavenumber over pi that is written as a fraction: 5 degrees of phase
LONGEST = 24  # letters of a list in a legend
DIGITS = range(3, 18)  # of a number, as few as tell the values apart; 17 tell all doubles apart
NO_BREAK = "\u00a0"  # the space between a value and its unit, at which no line breaks
LEAST_RATIO = 5.0  # of the largest to the smallest value of a logarithmic axis: over less the two scales look alike


class SweptKey(NamedTuple):
    """A key that varies: its ``path`` in the case, its ``unit`` (empty for none), and its ``values`` along the axis."""

    path: str
    unit: str
    values: np.ndarray

    @property
    def label(self) -> str:
        """The words for the key, with its unit in brackets."""
        return with_unit(key_name(self.path), self.unit)

    @property
    def is_number(self) -> bool:
        """Whether the values are numbers of which no two are equal."""
        return np.issubdtype(self.values.dtype, np.number) and len(np.unique(self.values)) == len(self.values)

    @property
    def value_texts(self) -> list[str]:
        """The values as texts that differ where they do, without the unit."""
        if self.path.endswith("wavenumber") and np.issubdtype(self.values.dtype, np.number):
            return [in_pi(value) for value in self.values]
        if np.issubdtype(self.values.dtype, np.number):
            return _number_texts(self.values)
        texts = [str(value) for value in self.values]
        shortened = [_shortened(text) for text in texts]
        # Lists may differ only beyond the letters for which a legend has room.
        if len(set(shortened)) < len(set(texts)):
            shortened = [f"{text} (no. {number})" for number, text in enumerate(shortened, 1)]
        return shortened

    @property
    def texts(self) -> list[str]:
        """The words for the key with each value and its unit: ``drive amplitude 24.3 N``."""
        unit = f"{NO_BREAK}{self.unit}" if self.unit else ""
        return [f"{key_words(self.path)} {text}{unit}" for text in self.value_texts]


def _number_texts(values: np.ndarray) -> list[str]:
    """Return the ``values`` in as few digits as tell them apart."""
    different = len(np.unique(values))
    for digits in DIGITS:
        texts = [_number_text(value, digits) for value in values]
        if len(set(texts)) == different:
            return texts
    return [repr(value) for value in values]


def _number_text(value: float, digits: int) -> str:
    """Return ``value`` in ``digits`` significant digits, with a power of ten only below 1e-4 and from 1e6 on."""
    text = f"{value:.{digits}g}"
    # The format has one from 10**digits on already: zeros take its place.
    if "e" in text and 1 <= abs(value) < 1e6:
        text = f"{float(text):.0f}"
    return text


def _shortened(text: str) -> str:
    """Return ``text`` in at most ``LONGEST`` letters, with the number of entries of a list."""
    if len(text) <= LONGEST:
        return text
    entries = f" {text.count(',') + 1} entries" if text.startswith("[") else ""
    return f"{text[: LONGEST - len(entries)]}…{entries}"


class SweptAxis(NamedTuple):
    """An axis of a sweep: its ``dimension``, and the ``keys`` that vary along it, with as many values each."""

    dimension: str
    keys: tuple[SweptKey, ...]

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.keys[0].values)

    @property
    def first_number(self) -> SweptKey | None:
        """The key whose values are positions on an axis of numbers; None if the values are categories."""
        if len(self.keys) > 1 and self.size <= FEW_TOGETHER:
            return None
        return next((key for key in self.keys if key.is_number), None)

    @property
    def is_number(self) -> bool:
        """Whether the axis has positions rather than categories."""
        return self.first_number is not None

    @property
    def label(self) -> str:
        """The label of the axis in a picture, with every key that varies along it."""
        first = self.first_number or self.keys[0]
        others = [key for key in self.keys if key.path != first.path]
        together = " and ".join(f"{key.label} from {key.value_texts[0]} to {key.value_texts[-1]}" for key in others)
        if self.is_number and others:
            return f"{first.label}, together with {together}"
        return ", ".join(key.label for key in self.keys)

    @property
    def texts(self) -> list[str]:
        """Every key with its value, for each position along the axis."""
        return [", ".join(texts) for texts in zip(*(key.texts for key in self.keys), strict=True)]

    @property
    def value_texts(self) -> list[str]:
        """The values alone, for each position along the axis."""
        return [", ".join(texts) for texts in zip(*(key.value_texts for key in self.keys), strict=True)]

    @property
    def positions(self) -> np.ndarray:
        """The numbers (value,) along the axis, or the numbers of its categories from 0."""
        number = self.first_number
        if number is None:
            return np.arange(self.size, dtype=float)
        return number.values.astype(float)

    @property
    def scale(self) -> str:
        """The scale on which the positions lie more evenly, "linear" or "log"."""
        if not self.is_number:
            return "linear"
        return even_scale(self.positions)

    @classmethod
    def all_of(cls, ensemble: xr.Dataset) -> list[Self]:
        """Return the axes of ``ensemble`` along which anything varies, in the order of its case."""
        case = tomllib.loads(ensemble.attrs["case"])
        axes = []
        for dimension in axes_of(ensemble):
            names = [name for name in ensemble.coords if ensemble[name].dims == (dimension,)]
            keys = [_swept_key(ensemble[name], case) for name in names]
            varying = [key for key in keys if len(set(key.values.tolist())) > 1]
            if varying:
                axes.append(cls(dimension, tuple(varying)))
        return axes


def _swept_key(values: xr.DataArray, case: dict[str, Any]) -> SweptKey:
    """Return the key whose ``values`` are a coordinate of the sweep of ``case``."""
    path = str(values.attrs["long_name"])
    return SweptKey(path, unit_of(path, case), values.values)


def even_scale(values: np.ndarray) -> str:
    """Return the scale, "linear" or "log", on which ``values`` (value,) lie more evenly."""
    ordered = np.unique(values)
    # Two values lie evenly on any scale.
    if len(ordered) < 3 or ordered[0] <= 0 or ordered[-1] < LEAST_RATIO * ordered[0]:
        return "linear"
    linear = np.diff(ordered)
    logarithmic = np.diff(np.log(ordered))
    if _unevenness(logarithmic) < _unevenness(linear):
        return "log"
    return "linear"


def _unevenness(steps: np.ndarray) -> float:
    return float(np.std(steps) / np.mean(steps))


def in_pi(wavenumber: float) -> str:
    """Return a ``wavenumber`` in rad/cell as a fraction of π such as 5π/9, or as a decimal if it is none."""
    multiple = float(wavenumber) / np.pi
    near = Fraction(multiple).limit_denominator(FRACTION_LIMIT)
    # Such fractions are near any number: only one that equals the number is written.
    if abs(float(near) - multiple) > 1e-6:
        return f"{multiple:.3f}π"
    text = "π"
    if near.numerator != 1:
        text = f"{near.numerator}π"
    if near.denominator > 1:
        text += f"/{near.denominator}"
    return text
