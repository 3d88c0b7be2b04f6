"""Two-view geometry of all edges at once: matched bearings are concatenated, with offsets as in `ViewGraph`."""
