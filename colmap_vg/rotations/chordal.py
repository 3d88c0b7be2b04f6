"""Chordal rotation averaging (RS of Nasiri et al.): ``min sum w_ij ||R_ij - R_j R_i^T||_F^2``.

The initial rotations are spectral: the three leading eigenvectors of the normalised block matrix of relative rotations
(Arie-Nachimson et al., 3DIMPVT 2012), projected on rotations. They are refined by a Riemannian Newton method with
conjugate gradients on the exact Hessian, preconditioned by the factored scalar graph Laplacian (the Hessian at
consistent rotations), and a monotone line search (Nocedal & Wright, Alg. 7.1). Negative curvature ends the inner loop,
so that the iteration leaves saddle points where it encounters negative curvature.
"""

import numpy as np
import scipy.sparse as sp
from numpy.typing import ArrayLike, NDArray

from colmap_vg.geometry import so3
from colmap_vg.linear.eigen import smallest_eigenpairs
from colmap_vg.linear.laplacian import ReweightedLaplacian
from colmap_vg.linear.solvers import Factor, factorize
from colmap_vg.rotations.chordal_matrix import TangentQuadratic, chordal_cost, chordal_matrix
from colmap_vg.rotations.problem import RotationResult, checked_initial, checked_problem
from colmap_vg.scene.solution import LogEntry

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

ARMIJO = 1e-4
"""Sufficient-decrease constant of the line search, dimensionless."""
MAX_STEP = 1.0
"""Largest rotation step of an image, radians; beyond it the quadratic model is inaccurate."""
MAX_CG_ITERATIONS = 200
"""Maximum number of conjugate-gradient iterations per Newton step."""


def average_rotations_chordal(
    num_images: int,
    edges: ArrayLike,
    cam2_from_cam1_rotations: ArrayLike,
    weights: ArrayLike | None = None,
    initial: ArrayLike | None = None,
    max_num_iterations: int = 100,
    tolerance: float = 1e-10,
) -> RotationResult:
    """Average rotations by minimising the chordal cost.

    Parameters
    ----------
    num_images : int
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
        ``R_ij = R_j R_i^T`` for cam_from_world rotations R.
    weights : (m,) array, optional
        Multipliers of squared residuals. Default: all one.
    initial : (n, 3, 3) array, optional
        Initial cam_from_world rotations. Default: spectral.
    max_num_iterations : int
        Maximum number of Newton steps.
    tolerance : float
        The iteration ends when no image's step is longer, radians. Convergence is quadratic: the next step would be far
        smaller.

    Returns
    -------
    RotationResult
        `cost` is the chordal objective. The gauge is that of the initial rotations.

    Raises
    ------
    GraphError
        The graph is malformed or disconnected.
    """
    edges, relative, w = checked_problem(num_images, edges, cam2_from_cam1_rotations, weights)
    R = checked_initial(num_images, initial)
    W = chordal_matrix(num_images, edges, relative, w)
    if R is None:
        R = _spectral_start(num_images, edges, w, W)
    if num_images == 1:
        return RotationResult(so3.project(R), 0.0, 0, True, ())
    R = so3.project(R)
    preconditioner = factorize(ReweightedLaplacian(num_images, edges).matrix(4.0 * w, ground=1.0))
    cost = chordal_cost(edges, relative, w, R)
    rounding = 1e-15 * float(w.sum())
    log: list[LogEntry] = []
    converged = False
    for iteration in range(1, max_num_iterations + 1):
        model = TangentQuadratic(W, R)
        v = _newton_direction(model, preconditioner)
        longest = float(np.linalg.norm(v, axis=1).max())
        if longest > MAX_STEP:
            v *= MAX_STEP / longest
        slope = float(np.einsum("na,na->", model.gradient, v))
        length = 1.0
        while True:
            trial = so3.project(R @ so3.exp(length * v))
            trial_cost = chordal_cost(edges, relative, w, trial)
            # Accept steps whose expected decrease is below rounding: the cost cannot judge them, the gradient can.
            if trial_cost <= cost + ARMIJO * length * slope or -length * slope <= rounding:
                break
            length *= 0.5
        change = length * min(longest, MAX_STEP)
        R, cost = trial, trial_cost
        log.append(LogEntry("rotations", iteration, cost, change))
        if change <= tolerance:
            converged = True
            break
    return RotationResult(R, cost, len(log), converged, tuple(log))


def _newton_direction(model: TangentQuadratic, preconditioner: Factor) -> Array:
    """Descent direction by truncated conjugate gradients on ``H v = -g``, for any curvature."""
    g = model.gradient
    v, r = np.zeros_like(g), -g
    z = _without_gauge(preconditioner, r)
    p, rz = z, float(np.einsum("na,na->", r, z))
    # Forcing term for quadratic convergence (eta ~ |g|), at most a tenth; |g| is measured as a step, in radians.
    eta = min(0.1, max(float(np.linalg.norm(z, axis=1).max()), 1e-8))
    goal = eta * eta * rz
    for iteration in range(MAX_CG_ITERATIONS):
        if rz <= goal:
            break
        Hp = model.hessian_times(p)
        curvature = float(np.einsum("na,na->", p, Hp))
        if curvature <= 0.0:
            return z if iteration == 0 else v
        step = rz / curvature
        v = v + step * p
        r = r - step * Hp
        z = _without_gauge(preconditioner, r)
        rz_new = float(np.einsum("na,na->", r, z))
        p = z + (rz_new / rz) * p
        rz = rz_new
    return v


def _without_gauge(preconditioner: Factor, r: Array) -> Array:
    """Pseudo-inverse of the Laplacian applied to r, with common rotations of all images projected out."""
    x = preconditioner.solve(r - r.mean(axis=0))
    return np.asarray(x - x.mean(axis=0))


def _spectral_start(num_images: int, edges: IntArray, weights: Array, W: sp.bsr_array) -> Array:
    """Rotations from the three leading eigenvectors of ``D^-1/2 W D^-1/2``, with the weighted degrees D."""
    if num_images == 1:
        return np.eye(3)[None]
    degree = np.bincount(edges[:, 0], weights, num_images) + np.bincount(edges[:, 1], weights, num_images)
    scale = sp.diags_array(np.repeat(1.0 / np.sqrt(degree), 3))
    normalized = sp.csc_array(sp.eye_array(3 * num_images) - scale @ W.tocsr() @ scale)
    _, vectors = smallest_eigenpairs(normalized, 3, tolerance=1e-3)  # a start: Newton does the rest
    blocks = vectors.reshape(num_images, 3, 3)
    # Eigenvectors are determined up to a common orthogonal factor: choose its sign so that determinants are positive.
    if np.sum(np.sign(np.linalg.det(blocks))) < 0:
        blocks = blocks * np.array([1.0, 1.0, -1.0])
    return so3.project(blocks)
