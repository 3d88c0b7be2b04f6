"""Solve a viewing graph alone: read it from a COLMAP database, solve it, and print what became of images and edges.

Usage: python examples/solve_view_graph.py DATABASE [METHOD]
"""

import sys
from collections import Counter

import numpy as np

import colmap_vg


def main(database_path: str, method: str = "epipolar") -> None:
    graph = colmap_vg.read_view_graph(database_path)  # the database is not modified
    solution = colmap_vg.solve_view_graph(graph, colmap_vg.SolveOptions(method=method))  # type: ignore[arg-type]
    print(f"{solution.status}: {solution.message}")

    names = graph.image_names or [str(image_id) for image_id in graph.image_ids]
    for name, registered, verdict, center in zip(
        names, solution.registered, solution.image_verdicts, solution.projection_centers, strict=True
    ):
        place = np.array2string(center, precision=3, suppress_small=True) if registered else ""
        print(f"image {name}: {verdict} {place}")

    for verdict, count in Counter(solution.edge_verdicts.tolist()).most_common():
        print(f"{count} edges: {verdict}")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(__doc__)
    try:
        main(*sys.argv[1:])
    except colmap_vg.ColmapVgError as error:
        sys.exit(f"error: {error}")
