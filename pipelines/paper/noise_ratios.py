"""Which method is most accurate at which ratio of direction to rotation noise.

Alg. 1 takes rotations as given, Alg. 2 lets directions correct them: the noisier directions are against rotations, the
less they have to tell.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_vg.metrics import position_errors
from colmap_vg.options import Method, SolveOptions
from colmap_vg.simulation.topology import TopologyNoise, scene_on_topology
from colmap_vg.solver.solve import solve_view_graph
from paper.markdown import markdown_table
from paper.real_edges import EdgeNoise, noise_table

Array = NDArray[np.float64]

NOISE_RATIOS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Standard deviation of directions over that of rotations, in each axis."""
ROTATION_DEG = 1.0
NUM_RATIO_SEEDS = 5
NUM_IMAGES, NUM_NEIGHBORS = 40, 6
"""Images on a ring, and the following images on it that each is linked to."""
CONTEST: tuple[Method, ...] = ("1C", "1O", "2C", "2O", "lud")
"""The paper's own methods, and the baseline that is nearest to them on Table 1's sets."""


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
    edges = ring_edges(NUM_IMAGES, NUM_NEIGHBORS)
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


def ring_edges(num_images: int, num_neighbors: int) -> NDArray[np.int64]:
    """Edges of each image on a ring to the following ones, (num_images * num_neighbors, 2)."""
    first = np.repeat(np.arange(num_images), num_neighbors)
    second = (first + np.tile(np.arange(1, num_neighbors + 1), num_images)) % num_images
    return np.stack([first, second], axis=1)


def ratio_table(errors: Mapping[str, Array]) -> str:
    """Markdown: a line for each method, the best of all at each ratio bold; below it, the best of `CONTEST`."""
    best = np.min(list(errors.values()), axis=0)
    table = [
        [
            method,
            *(f"**{e:.3g}**" if e == least else f"{e:.3g}" for e, least in zip(100.0 * row, 100.0 * best, strict=True)),
        ]
        for method, row in errors.items()
    ]
    text = markdown_table(["method", *(f"{ratio:g}" for ratio in NOISE_RATIOS)], table)
    found = contest_winners(errors)
    if found:
        won = ", ".join(f"{winner} at {ratio:g}" for ratio, winner in zip(NOISE_RATIOS, found, strict=True))
        text += f"\nLeast error among {_contestants(errors)}: {won}.\n"
    return text


def contest_winners(errors: Mapping[str, Array]) -> list[str]:
    """Method of `CONTEST` with the least error at each ratio; empty where none was solved."""
    names = [method for method in CONTEST if method in errors]
    if not names:
        return []
    return [names[row] for row in np.argmin([errors[name] for name in names], axis=0)]


def real_edges_text(errors: Mapping[str, Array], noises: Sequence[EdgeNoise]) -> str:
    """Markdown: noise of real edges, how it was estimated, and the best of `CONTEST` at the ratio nearest to theirs."""
    text = (
        "Noise of real edges, standard deviation in each axis: each graph was solved by the default options, and the"
        " median angle between measured and solved relative poses of the edges that the solution kept, divided by the"
        " median of a chi distribution with three degrees of freedom for rotations and two for directions. It is below"
        " the true noise: a solution fits its edges better than the truth does, and the filters drop those that fit"
        " worst. The ratio is affected less, unless the filters drop many more directions than rotations."
        f"\n\n{noise_table(noises)}"
    )
    winners = contest_winners(errors)
    for noise in noises if winners else ():
        nearest = int(np.argmin(np.abs(np.log(np.array(NOISE_RATIOS) / noise.ratio))))
        text += (
            f"\nAt {NOISE_RATIOS[nearest]:g}, the ratio above that is nearest to {noise.name.replace('_', ' ')}'s, the"
            f" least error among {_contestants(errors)} is that of {winners[nearest]}.\n"
        )
    return text


def _contestants(errors: Mapping[str, Array]) -> str:
    return ", ".join(method for method in CONTEST if method in errors)
