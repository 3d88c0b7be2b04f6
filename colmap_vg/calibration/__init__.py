"""Focal lengths from matches alone."""
