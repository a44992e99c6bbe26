"""Reproduction of the paper: its plan, claims, figures and report.

The paper is by Tempelman, Vakakis and Matlack, on wavenumber scattering and inter-band targeted energy transfer in
phononic lattices with local vibro-impacts (doi 10.1103/PhysRevE.108.044214). ``plan`` gathers the steps (``plan.toml``,
case files in ``cases/``), which ``steps`` computes; ``cell_search`` and ``cell_costs`` are the search of its
supplement. ``paper_figures`` has the figures (``figures.toml``), which ``draw`` draws, ``claims`` measures the claims
(``claims/claims.toml``), ``report`` writes the page. ``make`` does all of it in one folder; the record of
``steps`` keeps what was made of which inputs.
"""
