"""Pose-graph optimisation: rotations and positions jointly, from relative poses."""
