"""From COLMAP databases to view graphs, and from pose solutions to reconstructions."""
