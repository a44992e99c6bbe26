"""The paper's seventeen claims (SPEC.md 11) and one on its outlook, each measured from files."""

from vipetsc.paper.claims.measure import measure_claims, write_claims
