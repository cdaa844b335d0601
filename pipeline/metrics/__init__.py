"""Errors of poses and what follows from them, as bop_toolkit defines them."""
