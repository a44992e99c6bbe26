"""The paper's seventeen claims (SPEC.md 11), each measured from files in both readings of its parameters."""

from vipetsc.paper.claims.measure import measure_claims, write_claims
