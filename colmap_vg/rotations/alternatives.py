"""Alternative rotations a few images away: images are moved to the second-best rotation that their own edges support.

In scenes that repeat themselves, parts of the model may be folded onto each other. Images beside the seam of such a
fold often fit as well on its other side. Starts from elsewhere need not find this solution, but it differs in a few
images only.
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
    """Move images to their second-best rotation, one by one, each time the image that loses least support.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    weights : (m,) array
        Weight of each edge's vote.
    rotations : (n, 3, 3) array
        cam_from_world rotations.
    num_moved : int
        Maximum number of images to move; fewer are moved if no other image has a second rotation that edges support.

    Returns
    -------
    (n, 3, 3) array
        cam_from_world rotations.
    """
    # Each edge votes for both of its images, the heaviest edges first.
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
        # R_i Q is the rotation of image i that the edge votes for.
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
