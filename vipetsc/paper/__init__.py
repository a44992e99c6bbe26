"""Reproduction of the paper: its plan, claims, figures and report.

Tempelman, Vakakis and Matlack, on wavenumber scattering and inter-band targeted energy transfer in phononic lattices
with local vibro-impacts. ``plan`` gathers the steps (``plan.toml``, case files in ``cases/``), ``figures`` draws the
figures (``figures.toml``), ``claims`` measures the claims (``claims/claims.toml``); ``make`` computes all of it into
one folder, with ``report``.
"""
