"""The paper's seventeen claims and one on its outlook (``claims.toml``), each measured from files."""

from vipetsc.paper.claims.measure import measure_claims, write_claims
