"""Dual certificate of global optimality for chordal rotation averaging.

Eriksson et al., "Rotation Averaging and Strong Duality" (CVPR 2018); Rosen et al., SE-Sync (IJRR 2019). At a stationary
point X of ``f(X) = 6 sum w - tr(X^T W X)`` the multipliers of ``R_i R_i^T = I`` are ``Lambda_i = sym((W X)_i R_i^T)``.
For any other rotations Y, ``f(Y) >= f(X) + 3n min(0, lambda_min(S))`` with ``S = Lambda - W``: where S has no negative
eigenvalue, X is a global optimum. The bound holds at every X, stationary or not.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike

from colmap_vg.errors import GraphError
from colmap_vg.linear.eigen import smallest_eigenpairs
from colmap_vg.rotations.chordal_matrix import block_diagonal, chordal_cost, chordal_matrix
from colmap_vg.rotations.problem import checked_initial, checked_problem


@dataclass(frozen=True)
class ChordalCertificate:
    """Optimality certificate of given rotations.

    Attributes
    ----------
    smallest_eigenvalue : float
        Smallest eigenvalue of ``S = Lambda - W``, in the unit of the weights. The three columns of X are in the kernel
        of S, so at a global optimum this is zero up to rounding.
    is_global : bool
        Whether the smallest eigenvalue is at least minus the tolerance times the largest weighted degree.
    cost : float
        Chordal cost of the rotations.
    lower_bound : float
        Lower bound on the chordal cost of any rotations.
    relative_gap : float
        ``(cost - lower_bound) / cost``; ``(cost - lower_bound) / sum w`` where the cost is smaller than 1e-12 of that.
    stationarity : float
        ``max |S X|`` over the largest weighted degree: zero at a stationary point.
    """

    smallest_eigenvalue: float
    is_global: bool
    cost: float
    lower_bound: float
    relative_gap: float
    stationarity: float


def certify_chordal(
    num_images: int,
    edges: ArrayLike,
    cam2_from_cam1_rotations: ArrayLike,
    cam_from_world_rotations: ArrayLike,
    weights: ArrayLike | None = None,
    tolerance: float = 1e-9,
) -> ChordalCertificate:
    """Certify that rotations are a global optimum of chordal averaging, or bound their suboptimality.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam_from_world_rotations : (n, 3, 3) array
        The rotations to certify, from `average_rotations_chordal`.
    weights : (m,) array, optional
        Weights used for the averaging. Default: all one.
    tolerance : float
        Tolerance on the smallest eigenvalue, relative to the largest weighted degree.

    Returns
    -------
    ChordalCertificate

    Raises
    ------
    GraphError
        The graph is malformed or disconnected, or the rotations are None.
    """
    edges, relative, w = checked_problem(num_images, edges, cam2_from_cam1_rotations, weights)
    R = checked_initial(num_images, cam_from_world_rotations)
    if R is None:
        raise GraphError("certify_chordal needs the rotations to certify, found None")
    W = chordal_matrix(num_images, edges, relative, w)
    X = R.reshape(-1, 3)
    multipliers = (W @ X).reshape(-1, 3, 3) @ np.swapaxes(R, 1, 2)
    multipliers = 0.5 * (multipliers + np.swapaxes(multipliers, 1, 2))
    S = sp.csc_array(block_diagonal(multipliers).tocsc() - W.tocsc())
    values, _ = smallest_eigenpairs(S, 1)
    smallest = float(values[0])
    degree = np.bincount(edges[:, 0], w, num_images) + np.bincount(edges[:, 1], w, num_images)
    scale = float(degree.max(initial=0.0)) or 1.0
    cost = chordal_cost(edges, relative, w, R)
    lower_bound = cost + 3.0 * num_images * min(0.0, smallest)
    total = float(w.sum()) or 1.0
    return ChordalCertificate(
        smallest_eigenvalue=smallest,
        is_global=bool(smallest >= -tolerance * scale),
        cost=cost,
        lower_bound=max(0.0, lower_bound),
        relative_gap=(cost - max(0.0, lower_bound)) / (cost if cost > 1e-12 * total else total),
        stationarity=float(np.abs(S @ X).max(initial=0.0)) / scale,
    )
