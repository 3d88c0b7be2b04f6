"""Rotations, directions and similarities on arrays."""
