"""Rotation averaging: spanning tree, certified chordal optimum, robust averaging, and consensus over several starts."""
