"""Structure-less bundle adjustment: poses that minimise the epipolar errors of all inlier matches."""
