"""Nonlinear normal modes of conservative systems with contacts: shooting, continuation, stability."""
