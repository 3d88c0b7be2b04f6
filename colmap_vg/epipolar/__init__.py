"""Poses from the epipolar error of all inliers, without a 3D point."""
