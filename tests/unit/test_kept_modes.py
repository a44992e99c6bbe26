"""Modes kept between runs have the bits of computed ones, serve the same lattice alone, and never cause an error."""

import os
from dataclasses import replace

import numpy as np
import pytest

from vipetsc.io import kept_arrays as kept
from vipetsc.lattice import Chain, four_band
from vipetsc.lattice.modes import linear_modes
from vipetsc.spectra import kept_modes as module
from vipetsc.spectra.kept_modes import kept_modes

CHAIN = Chain(four_band(), 100, sites=(3,), clearances=(1e-3,))


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Put the user's cache into a temporary folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    module._kept.cache_clear()
    yield kept.cache_folder()
    module._kept.cache_clear()


def in_a_later_run(chain, monkeypatch):
    """Return the modes of ``chain`` as a later process reads them; computing them again fails the test."""
    module._kept.cache_clear()
    with monkeypatch.context() as later:
        later.setattr(module, "linear_modes", lambda chain: pytest.fail("computed again"))
        return kept_modes(chain)


def test_a_later_run_has_the_same_bits(monkeypatch):
    computed = linear_modes(CHAIN)
    kept_modes(CHAIN)
    found = in_a_later_run(CHAIN, monkeypatch)
    for name in ("frequency", "wavenumber", "vectors"):
        np.testing.assert_array_equal(getattr(found, name), getattr(computed, name))
    field = np.random.default_rng(0).standard_normal((2, 7, CHAIN.cells, CHAIN.cell.dofs))
    np.testing.assert_array_equal(found.amplitudes(*field), computed.amplitudes(*field))
    assert found.chain == computed.chain


@pytest.mark.parametrize(
    "other",
    [
        replace(CHAIN, ends="free"),
        replace(CHAIN, cells=101),
        replace(CHAIN, cell=four_band(lam=0.1 * (1 + 1e-15))),
        replace(CHAIN, cell=replace(CHAIN.cell, masses=tuple(np.nextafter(CHAIN.cell.masses, 1)))),
    ],
)
def test_another_lattice_has_modes_of_its_own(other, folder):
    kept_modes(CHAIN)
    found = kept_modes(other)
    np.testing.assert_array_equal(found.frequency, linear_modes(other).frequency)
    assert len([*folder.iterdir()]) == 2


def test_sites_make_no_difference(folder, monkeypatch):
    """Chains that differ in sites alone use the same kept modes."""
    kept_modes(CHAIN)
    in_a_later_run(replace(CHAIN, sites=(5,)), monkeypatch)


@pytest.mark.parametrize("damage", ["empty", "cut", "header", "number"])
def test_a_damaged_file_is_computed_again(damage, folder):
    computed = kept_modes(CHAIN).vectors.copy()
    (path,) = folder.iterdir()
    content = bytearray(path.read_bytes())
    if damage == "empty":
        content = bytearray()
    elif damage == "cut":
        content = content[:-100_000]
    elif damage == "header":
        content[10:40] = b"{" * 30
    else:
        content[len(content) // 2] ^= 1
    path.write_bytes(content)

    module._kept.cache_clear()
    np.testing.assert_array_equal(kept_modes(CHAIN).vectors, computed)
    # The file is whole again.
    assert len(path.read_bytes()) > 8 * computed.size


@pytest.mark.parametrize(
    ("old", "new"), [(b"'x'", b"'y'"), (b"(2, 3)", b"(3, 2)"), (b"<f8", b"<i8"), (b"(2, 3)", b"(2000000000000, 3)")]
)
def test_a_header_with_another_array_is_recognised(folder, old, new):
    """A damaged name, type or shape leaves the numbers as they are: the arrays are computed again for it."""

    def compute() -> dict[str, np.ndarray]:
        return {"x": np.full((2, 3), 1.5)}

    kept.kept_arrays("test", [b"a"], compute)
    (path,) = folder.iterdir()
    content = path.read_bytes()
    damaged = content.replace(old, new, 1)
    # The header has as many bytes as before: blanks at its end make up for longer words.
    damaged = damaged.replace((len(damaged) - len(content)) * b" ", b"", 1)
    assert len(damaged) == len(content) and damaged != content
    path.write_bytes(damaged)

    again = kept.kept_arrays("test", [b"a"], compute)
    assert again.keys() == {"x"}
    np.testing.assert_array_equal(again["x"], compute()["x"])


def test_the_folder_is_bounded_and_keeps_what_was_used_last(folder, monkeypatch):
    """Beyond its largest size the folder drops the arrays that were used longest ago."""

    def keep(name: bytes) -> None:
        kept.kept_arrays("test", [name], lambda: {"x": np.zeros(128)})

    keep(b"a")
    (first,) = folder.iterdir()
    size = first.stat().st_size
    monkeypatch.setattr(kept, "LARGEST", 3 * size)
    for age, name in ((20, b"b"), (10, b"c")):
        before = {*folder.iterdir()}
        keep(name)
        (path,) = {*folder.iterdir()} - before
        # Times of files are too coarse to order these calls, hence they are set.
        os.utime(path, (1e9 - age, 1e9 - age))
    os.utime(first, (1e9 - 30, 1e9 - 30))

    kept.kept_arrays("test", [b"a"], lambda: pytest.fail("a was dropped while there was room"))
    keep(b"d")
    assert sum(path.stat().st_size for path in folder.iterdir()) == 3 * size
    for name in (b"a", b"c", b"d"):
        kept.kept_arrays("test", [name], lambda: pytest.fail("what was used last was dropped"))


def test_a_cache_that_cannot_be_written_is_no_error(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    np.testing.assert_array_equal(kept_modes(CHAIN).frequency, linear_modes(CHAIN).frequency)
