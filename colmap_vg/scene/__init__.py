"""What is solved, and what comes out: viewing graphs, their parts, solutions, verdicts."""
