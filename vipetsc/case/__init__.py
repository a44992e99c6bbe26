"""What to simulate: strict TOML in, a typed, frozen and fully resolved case out."""

from vipetsc.case.case import Case, Model
from vipetsc.case.schema import CaseError, Problem
from vipetsc.case.sweep import Member, Sweep

__all__ = ["Case", "CaseError", "Member", "Model", "Problem", "Sweep"]
