"""Triangulation, bundle adjustment and registration of a COLMAP model."""
