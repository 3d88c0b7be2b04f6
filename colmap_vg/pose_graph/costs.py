"""Objectives of pose-graph optimisation, with the gradient and Hessian blocks of each edge.

With ``Q_i`` camera to world (``cam_from_world`` transposed), ``R_ij`` the measured ``cam2_from_cam1`` rotation and
``t_ij`` the measured centre of camera j in camera i's frame, there are two objectives:

* :class:`ChordalCost`, with a scalar weight for each term (eq. PGO of Nasiri et al.)::

      sum kappa_ij ||R_ij - Q_j^T Q_i||_F^2 + tau_ij ||Q_i t_ij - (p_j - p_i)||^2

* :class:`InformationCost`, with a full information matrix for each edge::

      sum e^T Omega_ij e,   e = [log(Q_j^T Q_i R_ij^T), Q_i^T (p_j - p_i) - t_ij]

  with the rotation vector in camera j's frame. For small angles ``Omega = diag(2 kappa I, tau I)`` gives the first one.

Derivatives are by ``w`` and ``x`` in ``Q <- exp(w) Q, p <- p + x``.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from colmap_vg.geometry import so3

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]

MIN_TRACE = 1.5
"""Trace of the residual rotation (about 75 degrees) below which the chordal Hessian, close to losing definiteness, is
replaced by the Gauss-Newton one."""


@dataclass(frozen=True, eq=False)
class EdgeTerms:
    """Derivatives of each edge's cost by the poses of its two cameras i and j, rotation before position.

    Attributes
    ----------
    gradient_i, gradient_j : (m, 6) array
    ii, jj, ij : (m, 6, 6) array
        Positive semidefinite approximation of the Hessian.
    curvature_ii, curvature_jj, curvature_ij : (m, 3, 3) array or None
        Difference of the rotation blocks between the exact Hessian and the approximation; may be indefinite.
    """

    gradient_i: Array
    gradient_j: Array
    ii: Array
    jj: Array
    ij: Array
    curvature_ii: Array | None = None
    curvature_jj: Array | None = None
    curvature_ij: Array | None = None


class PoseGraphCost(Protocol):
    """Objective for the solver of :mod:`colmap_vg.pose_graph.gauss_newton`."""

    def value(self, Q: Array, p: Array) -> float:
        """The objective at camera-to-world rotations Q (n, 3, 3) and centres p (n, 3)."""

    def best_scale(self, Q: Array, p: Array) -> float:
        """Factor of the centres p of least cost."""

    def gradients(self, Q: Array, p: Array) -> tuple[Array, Array]:
        """Gradient of each edge's cost by the poses of its first and its second camera, (m, 6) each."""

    def derivatives(self, Q: Array, p: Array) -> EdgeTerms:
        """Gradient and Hessian of each edge."""


@dataclass(frozen=True, eq=False)
class ChordalCost:
    """Weighted sum of squared chordal rotation residuals and squared translation residuals.

    Attributes
    ----------
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_translations : (m, 3) array
    kappa, tau : (m,) array
        Weights of the rotation and of the translation term.
    """

    edges: IntArray
    cam2_from_cam1_rotations: Array
    cam2_in_cam1_translations: Array
    kappa: Array
    tau: Array

    def value(self, Q: Array, p: Array) -> float:
        i, j = self.edges[:, 0], self.edges[:, 1]
        chordal = self.cam2_from_cam1_rotations - np.swapaxes(Q[j], 1, 2) @ Q[i]
        residual = np.einsum("kab,kb->ka", Q[i], self.cam2_in_cam1_translations) - (p[j] - p[i])
        return float(
            np.sum(self.kappa * np.einsum("kab,kab->k", chordal, chordal))
            + np.sum(self.tau * np.einsum("ka,ka->k", residual, residual))
        )

    def best_scale(self, Q: Array, p: Array) -> float:
        i, j = self.edges[:, 0], self.edges[:, 1]
        s, d = (Q[i] @ self.cam2_in_cam1_translations[:, :, None])[:, :, 0], p[j] - p[i]
        return float(self.tau @ np.einsum("ka,ka->k", s, d) / (self.tau @ np.einsum("ka,ka->k", d, d)))

    def gradients(self, Q: Array, p: Array) -> tuple[Array, Array]:
        M, s, pull = self._turned(Q, p)
        return self._gradients(so3.vee(M), s, pull)

    def derivatives(self, Q: Array, p: Array) -> EdgeTerms:
        M, s, pull = self._turned(Q, p)
        skew = so3.vee(M)
        gradient_i, gradient_j = self._gradients(skew, s, pull)

        # Exact Hessian of the chordal term by u while it is safely definite, Gauss-Newton Hessian of the translations.
        trace = np.trace(M, axis1=1, axis2=2)[:, None, None]
        exact = trace * np.eye(3) - 0.5 * (M + np.swapaxes(M, 1, 2))
        chordal_hessian = 2.0 * self.kappa[:, None, None] * exact
        C = np.where(trace > MIN_TRACE, chordal_hessian, 4.0 * self.kappa[:, None, None] * np.eye(3))
        S, weight = so3.hat(s), 2.0 * self.tau[:, None, None]
        ii, jj, ij = (np.zeros((len(s), 6, 6)) for _ in range(3))
        ii[:, :3, :3] = C + weight * (np.swapaxes(S, 1, 2) @ S)
        ii[:, :3, 3:] = weight * S  # (-S)^T I
        ii[:, 3:, :3] = np.swapaxes(ii[:, :3, 3:], 1, 2)
        ii[:, 3:, 3:] = jj[:, 3:, 3:] = weight * np.eye(3)
        jj[:, :3, :3] = C
        ij[:, :3, :3] = -C
        ij[:, :3, 3:] = -weight * S
        ij[:, 3:, 3:] = -weight * np.eye(3)
        # exp(-w_j) exp(w_i) rotates by w_i - w_j - (w_j x w_i) / 2 + ...; Q_i t changes by w_i x (w_i x s) / 2, too.
        outer = pull[:, :, None] * s[:, None, :]
        along = np.einsum("ka,ka->k", pull, s)[:, None, None] * np.eye(3)
        curvature_jj = chordal_hessian - C
        curvature_ii = 0.5 * (outer + np.swapaxes(outer, 1, 2)) - along + curvature_jj
        curvature_ij = 2.0 * self.kappa[:, None, None] * so3.hat(skew) - curvature_jj
        return EdgeTerms(gradient_i, gradient_j, ii, jj, ij, curvature_ii, curvature_jj, curvature_ij)

    def _turned(self, Q: Array, p: Array) -> tuple[Array, Array, Array]:
        """Residual rotations (m, 3, 3), measured displacements and pulls on the positions (m, 3), world frame."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        M = Q[j] @ self.cam2_from_cam1_rotations @ np.swapaxes(Q[i], 1, 2)
        s = (Q[i] @ self.cam2_in_cam1_translations[:, :, None])[:, :, 0]
        return M, s, 2.0 * self.tau[:, None] * (s - (p[j] - p[i]))

    def _gradients(self, skew: Array, s: Array, pull: Array) -> tuple[Array, Array]:
        # ||M - exp(u)||^2 with u = w_i - w_j has gradient -4 vee(M); delta (Q_i t) = w_i x s.
        turn = -4.0 * self.kappa[:, None] * skew
        return np.concatenate([turn + np.cross(s, pull), pull], axis=1), np.concatenate([-turn, -pull], axis=1)


@dataclass(frozen=True, eq=False)
class InformationCost:
    """Sum of squared Mahalanobis lengths of relative-pose residuals.

    Attributes
    ----------
    edges : (m, 2) int array
    cam2_from_cam1_rotations : (m, 3, 3) array
    cam2_in_cam1_translations : (m, 3) array
    information : (m, 6, 6) array
        Symmetric positive semidefinite; rotation vector in camera 2's frame first, translation in camera 1's second.
    """

    edges: IntArray
    cam2_from_cam1_rotations: Array
    cam2_in_cam1_translations: Array
    information: Array

    def residuals(self, Q: Array, p: Array) -> Array:
        """Residuals ``[log(Q_j^T Q_i R_ij^T), Q_i^T (p_j - p_i) - t_ij]``, (m, 6)."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        turn = np.swapaxes(Q[j], 1, 2) @ Q[i] @ np.swapaxes(self.cam2_from_cam1_rotations, 1, 2)
        translation = np.einsum("kba,kb->ka", Q[i], p[j] - p[i])
        return np.concatenate([so3.log(turn), translation - self.cam2_in_cam1_translations], axis=1)

    def value(self, Q: Array, p: Array) -> float:
        e = self.residuals(Q, p)
        return float(np.einsum("ka,kab,kb->", e, self.information, e, optimize=True))

    def best_scale(self, Q: Array, p: Array) -> float:
        e = self.residuals(Q, p)
        e[:, 3:] = -self.cam2_in_cam1_translations  # at scale 0; the residuals grow by d with the scale
        i, j = self.edges[:, 0], self.edges[:, 1]
        d = np.einsum("kba,kb->ka", Q[i], p[j] - p[i])
        weighted = np.einsum("kab,kb->ka", self.information[:, :, 3:], d)
        return float(-np.vdot(e, weighted) / np.vdot(d, weighted[:, 3:]))

    def gradients(self, Q: Array, p: Array) -> tuple[Array, Array]:
        return self._linearized(Q, p)[:2]

    def derivatives(self, Q: Array, p: Array) -> EdgeTerms:
        gradient_i, gradient_j, J_i, J_j = self._linearized(Q, p)
        OJ_i, OJ_j = 2.0 * self.information @ J_i, 2.0 * self.information @ J_j
        T_i, T_j = np.swapaxes(J_i, 1, 2), np.swapaxes(J_j, 1, 2)
        return EdgeTerms(gradient_i, gradient_j, T_i @ OJ_i, T_j @ OJ_j, T_i @ OJ_j)

    def _linearized(self, Q: Array, p: Array) -> tuple[Array, Array, Array, Array]:
        """Gradients (m, 6) by the poses of both cameras, and derivatives (m, 6, 6) of the residuals by them."""
        i, j = self.edges[:, 0], self.edges[:, 1]
        e = self.residuals(Q, p)
        into_i = np.swapaxes(Q[i], 1, 2)
        turn = so3.left_jacobian_inverse(e[:, :3]) @ np.swapaxes(Q[j], 1, 2)
        J_i, J_j = np.zeros((len(e), 6, 6)), np.zeros((len(e), 6, 6))
        J_i[:, :3, :3], J_j[:, :3, :3] = turn, -turn
        J_i[:, 3:, :3] = into_i @ so3.hat(p[j] - p[i])
        J_i[:, 3:, 3:], J_j[:, 3:, 3:] = -into_i, into_i
        weighted = 2.0 * np.einsum("kab,kb->ka", self.information, e)
        return np.einsum("kab,ka->kb", J_i, weighted), np.einsum("kab,ka->kb", J_j, weighted), J_i, J_j
