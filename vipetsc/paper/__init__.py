"""The paper this package comes from, and nothing else: its plan, claims, figures and report.

Tempelman, Vakakis and Matlack, on wavenumber scattering and inter-band targeted energy transfer in phononic lattices
with local vibro-impacts. ``plan`` lists the steps (``steps``; case files in ``cases/``), ``figures`` the figures
(drawn by ``pictures``), ``claims`` measures the claims against ``claims.thresholds``; ``make`` makes all of it in one
folder with ``report``, and ``tables`` prints what is done.
"""
