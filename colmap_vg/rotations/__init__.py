"""Rotation averaging: spanning tree, chordal optimum with its certificate, robust averaging."""
