"""Sparse symmetric systems on graphs: assembly with a fixed pattern, solvers, eigenvalues, and robust weights."""
