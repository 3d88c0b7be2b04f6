"""Sparse symmetric systems on graphs: assembly on a fixed pattern and one adapter to the solvers."""
