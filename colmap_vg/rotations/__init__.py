"""Rotation averaging: absolute rotations from relative ones."""
