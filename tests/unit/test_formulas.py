"""Formulas of the manual in a terminal."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import vipetsc
from vipetsc.cli.chapters import CODE, plain
from vipetsc.cli.formulas import FormulaError, formula_text

MANUAL = Path(vipetsc.__file__).parent / "manual"


@pytest.mark.parametrize(
    ("latex", "text"),
    [
        (r"M \ddot u + K u = \sum_i b_i F_i", "M ü + K u = ∑ᵢ bᵢ Fᵢ"),
        (r"\frac{a + b}{2 N}", "(a + b)/(2 N)"),
        (r"\tfrac12 m v^2", "1/2 m v²"),
        (r"\log\frac{1 + c}{2}", "log((1 + c)/2)"),
        (r"\frac{\mathrm d\omega}{\mathrm d\kappa}", "dω/dκ"),
        (r"\sqrt{\kappa_c/\kappa}", "√(κ_c/κ)"),
        (r"\sqrt{m_j(x)}\, v", "√(mⱼ(x)) v"),
        (r"e^{i \kappa j}", "e^(i κ j)"),
        (r"\int_{t_0}^{t_1} F", "∫_t₀^t₁ F"),
        (r"e^{i\kappa} z", "e^(iκ) z"),
        (r"k_c x^{n+1}", "k_c xⁿ⁺¹"),
        (r"\dot w/\dot w_-", "ẇ/ẇ₋"),
        (r"w = u_\text{host} - 1", "w = u_host − 1"),
        (r"\int_0^t f \, \mathrm dt", "∫₀ᵗ f dt"),
        (r"\text{the drive's}\quad x", "the drive's    x"),
        (r"\begin{aligned} a &= b && \text{one} \\ c &= d \end{aligned}", "a = b    one\nc = d"),
        (r"\left( 1 - \cos \Omega t \right)", "( 1 − cos Ω t )"),
    ],
)
def test_latex_becomes_unicode(latex, text):
    """Fractions and roots keep their extent, scripts are raised and lowered, rows stay rows."""
    assert formula_text(latex) == text


@pytest.mark.parametrize("latex", [r"\foo x", r"\frac{a}", "{a"])
def test_what_is_no_formula_of_the_manual_is_refused(latex):
    """A command that no table has, a missing argument and an open bracket are errors."""
    with pytest.raises(FormulaError):
        formula_text(latex)


def formulas() -> list[str]:
    """Return every formula of the manual's chapters."""
    found = []
    for page in sorted(MANUAL.rglob("*.md")):
        prose = "".join(CODE.split(page.read_text(encoding="utf-8"))[::2])
        found += [shown or inline for shown, inline in re.findall(r"(?s)\$\$(.+?)\$\$|\$([^$]+?)\$", prose)]
    return found


def test_every_formula_of_the_manual_is_readable_in_a_terminal():
    """No command and no bracket of LaTeX is left of any formula."""
    assert len(formulas()) > 100
    for latex in formulas():
        assert not re.search(r"\\|\{|\}", formula_text(latex)), latex


def test_plain_chapters_have_words_for_terms_and_keep_code():
    """Roles and directives go, formulas become text in prose and tables, dollars in code stay."""
    text = "A {term}`site` ({term}`sites <site>`), $x^2$, `$HOME`.\n\n| $a_1$ | b |\n|---|---|\n| 1 | $|w|$ |\n"
    text += "\n```{glossary}\nsite\n  a cell\n```\n\n```sh\necho $A $B\n```\n\n$$\nx = \\tfrac12\n$$\n"

    shown = plain(text)

    assert shown.startswith("A site (sites), x², `$HOME`.\n\na₁  b\n")
    assert "\nsite\n  a cell\n" in shown
    assert "echo $A $B" in shown
    assert shown.endswith("\n    x = 1/2\n")
    assert "{" not in shown


def test_wide_tables_become_lists():
    """A table whose columns fit a terminal stays one; of a wider one each row is an entry with the names of columns."""
    narrow = plain("| a | b | c |\n|---|---|---|\n| 1 | 2 | 3 |\n")
    assert narrow == "a  b  c\n1  2  3\n"

    long = "word " * 10
    wide = plain(f"| message | reason | remedy |\n|---|---|---|\n| {long} | {long} | wait |\n")
    assert wide == f"  {long.strip()}\n      reason: {long.strip()}\n      remedy: wait\n"
