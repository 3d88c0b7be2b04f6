"""Data types: viewing graphs, their parts, solutions, and verdicts."""
