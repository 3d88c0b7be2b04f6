"""Translation averaging: camera positions from directions at known rotations."""
