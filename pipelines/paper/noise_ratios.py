"""Which method is most accurate at which ratio of direction to rotation noise.

Alg. 1 takes rotations as given, Alg. 2 lets directions correct them: the noisier directions are against rotations, the
less they have to tell.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_vg.metrics import position_errors
from colmap_vg.options import Method, SolveOptions
from colmap_vg.simulation.topology import TopologyNoise, scene_on_topology
from colmap_vg.solver.solve import solve_view_graph

Array = NDArray[np.float64]

NOISE_RATIOS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Standard deviation of directions over that of rotations, in each axis."""
ROTATION_DEG = 1.0
NUM_RATIO_SEEDS = 5
NUM_IMAGES, NUM_NEIGHBORS = 40, 6
"""Images on a ring, and the following images on it that each is linked to."""


def errors_by_ratio(methods: Sequence[Method], num_seeds: int) -> dict[str, Array]:
    """Median error of positions at each of `NOISE_RATIOS`, as a share of the ring's radius (root mean square).

    Parameters
    ----------
    methods : sequence of str
    num_seeds : int
        Number of rings, over which the median is taken.

    Returns
    -------
    dict of method to (k,) array
    """
    first = np.repeat(np.arange(NUM_IMAGES), NUM_NEIGHBORS)
    edges = np.stack([first, (first + np.tile(np.arange(1, NUM_NEIGHBORS + 1), NUM_IMAGES)) % NUM_IMAGES], axis=1)
    errors = np.empty((len(methods), len(NOISE_RATIOS), num_seeds))
    for column, ratio in enumerate(NOISE_RATIOS):
        noise = TopologyNoise(
            rotation_deg=ROTATION_DEG, direction_deg=ratio * ROTATION_DEG, baseline_power=0.0, match_spread=0.0
        )
        for seed in range(num_seeds):
            scene = scene_on_topology(NUM_IMAGES, edges, layout="ring", noise=noise, seed=seed)
            truth = scene.projection_centers
            radius = np.sqrt(np.mean(np.sum((truth - truth.mean(axis=0)) ** 2, axis=1)))
            for row, method in enumerate(methods):
                options = SolveOptions(
                    method=method,
                    rotation_averaging="chordal",
                    rotation_gate_deg=0.0,
                    outlier_filter="none",
                    edge_weights="unit",
                )
                found = solve_view_graph(scene.graph, options).projection_centers
                errors[row, column, seed] = position_errors(found, truth).median / radius
    return {method: np.median(errors[row], axis=1) for row, method in enumerate(methods)}
