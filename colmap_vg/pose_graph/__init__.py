"""Rotations and positions together, from relative poses."""
