"""Read COLMAP databases as arrays, and turn pose solutions into COLMAP reconstructions."""
