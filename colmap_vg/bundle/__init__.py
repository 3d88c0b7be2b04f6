"""Triangulation and bundle adjustment: poses, lenses and points that fit the keypoints best."""
