"""Formulas of the manual as a terminal shows them: the LaTeX that its chapters use, in Unicode."""

import re
import unicodedata

WIDE = "\N{EM SPACE}"
SYMBOLS = {
    **{name: unicodedata.lookup(f"GREEK SMALL LETTER {name.upper()}") for name in (
        "alpha", "beta", "gamma", "delta", "zeta", "eta", "theta", "kappa", "mu", "nu", "xi", "pi", "rho", "sigma",
        "tau", "chi", "psi", "omega",
    )},
    "lambda": "λ", "epsilon": "ε", "varepsilon": "ε", "phi": "φ", "varphi": "φ",
    "Delta": "Δ", "Omega": "Ω", "Phi": "Φ", "Psi": "Ψ", "Lambda": "Λ",
    "sum": "∑", "int": "∫", "infty": "∞", "partial": "∂", "sqrt": "√",
    "cdot": "·", "times": "×", "pm": "±", "mp": "∓", "ast": "*", "top": "ᵀ", "dagger": "†", "star": "*",
    "le": "≤", "ge": "≥", "ne": "≠", "approx": "≈", "sim": "∼", "propto": "∝", "ll": "≪", "gg": "≫", "equiv": "≡",
    "in": "∈", "to": "→", "mapsto": "↦", "dots": "…", "langle": "⟨", "rangle": "⟩", "lvert": "∣", "rvert": "∣",
    "prime": "′",
    "quad": WIDE, "qquad": WIDE, ",": " ", ";": " ", ":": " ", "!": "", " ": " ",
    "{": "{", "}": "}", "%": "%", "_": "_", "|": "‖",
}  # fmt: skip
FUNCTIONS = ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "ln", "det", "min", "max", "arg", "lim")
ACCENTS = {
    "dot": "\N{COMBINING DOT ABOVE}",
    "ddot": "\N{COMBINING DIAERESIS}",
    "hat": "\N{COMBINING CIRCUMFLEX ACCENT}",
    "bar": "\N{COMBINING MACRON}",
    "tilde": "\N{COMBINING TILDE}",
}
# Commands that change the typeface of their argument, and commands that change sizes; both leave the text as it is.
TYPEFACES = ("mathrm", "mathbf", "boldsymbol", "text", "operatorname", "mathcal", "mathit")
SIZES = ("left", "right", "big", "Big", "bigl", "bigr", "displaystyle")
FRACTIONS = ("frac", "tfrac", "dfrac")
RAISED = dict(zip("0123456789+−=()ijkmnptx*′ᵀ", "⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻⁼⁽⁾ⁱʲᵏᵐⁿᵖᵗˣ*′ᵀ", strict=True))
LOWERED = dict(zip("0123456789+−=()aehijklmnoprstuvx", "₀₁₂₃₄₅₆₇₈₉₊₋₌₍₎ₐₑₕᵢⱼₖₗₘₙₒₚᵣₛₜᵤᵥₓ", strict=True))
TOKEN = re.compile(r"\\[a-zA-Z]+|\\.|\s+|.", flags=re.S)
# A text that is one factor, which a fraction or a root takes without brackets.
FACTOR = re.compile(r"[^\s+\-−=·×/()]*")
# The begin and end of an environment, and the marks between its columns.
MARKS = re.compile(r"\\(?:begin|end)\{\w+\*?\}|&+")


class FormulaError(ValueError):
    """A formula has LaTeX that is not among what the manual uses."""


def formula_text(formula: str) -> str:
    r"""Return a formula in LaTeX as Unicode text, a line for every row that ends in ``\\``.

    Fractions become quotients, with brackets where they need some; scripts are raised and lowered where Unicode has
    all their letters, and follow ``^`` or ``_`` elsewhere. Raises FormulaError for a command that no table has.
    """
    rows = re.split(r"\\\\(?:\[[^]]*\])?", MARKS.sub(lambda mark: _gap(mark[0]), formula))
    texts = [_rendered([token[0] for token in TOKEN.finditer(row)]) for row in rows]
    lines = [re.sub(r"\s+", _blank, text).strip() for text in texts]
    return "\n".join(line for line in lines if line)


def _blank(space: re.Match[str]) -> str:
    """Return what replaces a run of blanks: one blank, or four if a wide space (``quad``, ``&&``) is among them."""
    if WIDE in space[0]:
        return "    "
    return " "


def _gap(mark: str) -> str:
    """Return what replaces a ``mark``, which begins or ends an environment, or separates its columns."""
    return {"&": " ", "&&": WIDE}.get(mark, "")


def _rendered(tokens: list[str]) -> str:
    """Return the text of all ``tokens``, which are taken out of the list."""
    parts = []
    while tokens:
        parts.append(_next(tokens))
    # An accent joins its letter.
    return unicodedata.normalize("NFC", "".join(parts))


def _next(tokens: list[str]) -> str:
    """Return the text of the next token with its arguments, which are taken out of ``tokens``."""
    token = tokens.pop(0)
    if token == "{":
        return _rendered(_group(tokens))
    if token in "^_":
        is_word = tokens[:1] in (["\\text"], ["\\mathrm"])
        return _script(token, _argument(tokens), is_word)
    if token.startswith("\\"):
        return _command(token[1:], tokens)
    if token.isspace():
        if WIDE in token:
            return WIDE
        return " "
    return {"-": "−", "'": "′", "~": " "}.get(token, token)


def _command(name: str, tokens: list[str]) -> str:
    """Return the text of the command ``name`` with its arguments, which are taken out of ``tokens``."""
    if name in FRACTIONS:
        # In this order: each call takes the next argument.
        upper = _argument(tokens)
        lower = _argument(tokens)
        return f"{_factor(upper)}/{_factor(lower)}"
    if name == "sqrt":
        return "√" + _factor(_argument(tokens))
    if name in ACCENTS:
        return _argument(tokens) + ACCENTS[name]
    if name == "text" and tokens[:1] == ["{"]:
        tokens.pop(0)
        return "".join(_group(tokens)).replace("\\", "")
    if name in TYPEFACES:
        return _argument(tokens)
    if name in SIZES:
        return ""
    if name in FUNCTIONS:
        if tokens and tokens[0].removeprefix("\\") in FRACTIONS:
            return f"{name}({_next(tokens)})"
        # A blank before letters and commands, none before brackets and scripts.
        is_followed = bool(tokens) and (tokens[0].isalnum() or tokens[0].startswith("\\"))
        return name + " " * is_followed
    if name not in SYMBOLS:
        raise FormulaError(f"\\{name} is no command of the manual's formulas")
    return SYMBOLS[name]


def _script(mark: str, text: str, is_word: bool) -> str:
    """Return the exponent (``mark`` ^) or index (_) ``text`` raised or lowered, if Unicode has its letters.

    A word, and what Unicode cannot raise, follows the mark, in brackets unless it reads as one factor without them.
    """
    letters = {"^": RAISED, "_": LOWERED}[mark]
    if text and not is_word and all(character in letters for character in text):
        return "".join(letters[character] for character in text)
    # A letter with an index of its own is one factor.
    has_one_letter = all(character in LOWERED.values() for character in text[1:])
    if is_word or has_one_letter or (mark == "_" and FACTOR.fullmatch(text)):
        return mark + text
    return f"{mark}({text})"


def _factor(text: str) -> str:
    """Return a numerator, denominator or radicand, in brackets unless it is one factor."""
    text = text.strip()
    if FACTOR.fullmatch(text):
        return text
    return f"({text})"


def _argument(tokens: list[str]) -> str:
    """Return the text of the next group or single token, which is taken out of ``tokens``."""
    while tokens and tokens[0].isspace():
        tokens.pop(0)
    if not tokens:
        raise FormulaError("a command lacks its argument")
    return _next(tokens)


def _group(tokens: list[str]) -> list[str]:
    """Return the tokens up to the bracket that ends the group; they and the bracket are taken out of ``tokens``."""
    depth = 1
    inner: list[str] = []
    while tokens:
        token = tokens.pop(0)
        depth += (token == "{") - (token == "}")
        if depth == 0:
            return inner
        inner.append(token)
    raise FormulaError("a bracket { is not closed")
