"""Rotations and positions together: pose-graph optimisation and Algorithm 2."""
