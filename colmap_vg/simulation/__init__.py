"""Synthetic scenes with known poses, for research and tests; not used by jobs."""
