"""What to simulate: strict TOML in, a typed, frozen and fully resolved case out."""

from vipetsc.case.case import Case, Model
from vipetsc.case.schema import CaseError, Problem

__all__ = ["Case", "CaseError", "Model", "Problem"]
