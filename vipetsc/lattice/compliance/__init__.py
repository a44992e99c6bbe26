"""Compliances of lattices: the motion per harmonic force, with one module for each way to compute it.

``by_waves`` has Bloch waves, of equal cells without dashpots; ``by_modes`` poles and residues, of any cells, and
``open_ends`` these with ends that reflect nothing; ``by_elimination`` solves at each frequency; ``dense`` has all modes
of a small system. All but the last are of a ``Chain``, and have the loads and signs of ``base`` in common.
"""
