"""Solver of viewing graphs: a sequence of stages with outlier filters and a shared state."""
