"""The nearest other solution: images whose own edges would have them elsewhere almost as well, moved there.

A fold has a seam, and where a scene repeats itself the seam may lie anywhere: the images beside it fit as well on its
other side. No start needs to find that other fold; it is a few images away.
"""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import quaternions
from colmap_vg.rotations.votes import agree_within, count_votes

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def nearest_alternative(
    num_images: int,
    edges: IntArray,
    cam2_from_cam1_rotations: Array,
    weights: Array,
    rotations: Array,
    num_moved: int,
) -> Array:
    """Rotations after the images that lose least by it have been turned to their second choice, one after the other.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array
        Votes of each edge.
    rotations : (n, 3, 3) array
        cam_from_world.
    num_moved : int
        At most; fewer where no other image's edges agree on a second choice.

    Returns
    -------
    (n, 3, 3) array
    """
    # Each edge votes at both of its images, the heaviest first.
    own, other = edges.T.ravel(), edges[:, ::-1].T.ravel()
    votes = np.tile(weights, 2)
    relative = quaternions.from_matrices(cam2_from_cam1_rotations)
    to_own = np.concatenate([quaternions.conjugate(relative), relative], axis=1)
    order = np.lexsort((np.arange(len(own)), -votes, own))
    own, other, votes, to_own = own[order], other[order], votes[order], to_own[:, order]
    images, sizes = np.unique(own, return_counts=True)
    run = np.repeat(np.arange(len(images)), sizes)
    q, moved = quaternions.from_matrices(rotations), np.zeros(num_images, dtype=bool)
    still = np.array([0.0, 0.0, 0.0, 1.0])[:, None]
    for _ in range(num_moved):
        # R_i Q is where the edge would have image i.
        wanted = quaternions.multiply(to_own, q[:, other])
        turn = quaternions.multiply(quaternions.conjugate(q[:, own]), wanted)
        here = agree_within(turn, still)
        present = np.bincount(run, votes * here)
        elsewhere, support, _ = count_votes(turn, np.where(here, 0.0, votes), sizes)
        ratio = np.where(moved[images] | (support == 0), -1.0, support / np.maximum(present, 1e-12))
        best = int(np.argmax(ratio))
        if ratio[best] <= 0.0:
            break
        image = images[best]
        q[:, image] = quaternions.multiply(q[:, image : image + 1], elsewhere[:, best : best + 1])[:, 0]
        moved[image] = True
    return quaternions.to_matrices(q)
