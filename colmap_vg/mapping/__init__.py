"""Triangulation, bundle adjustment and registration, by pycolmap."""
