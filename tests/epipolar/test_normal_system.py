"""Normal equations of terms with two and three cameras against a dense twin."""

import numpy as np
import pytest

from colmap_vg.epipolar.normal_system import MIN_DAMPING, CameraTerms, NormalSystem


def random_terms(images, rng, *, with_focals, with_radial):
    q, s = images.shape
    J = rng.standard_normal((q, 40, 6 * s + s + with_radial))
    r = rng.standard_normal((q, 40))
    gradients, hessians = np.einsum("qka,qk->qa", J, r), np.einsum("qka,qkb->qab", J, J)
    p = 6 * s
    if not with_focals:
        gradients, hessians = gradients[:, :p], hessians[:, :p, :p]
    chain = np.tile(np.eye(p), (q, 1, 1))
    return CameraTerms.chained(images, (r**2).sum(axis=1), gradients, hessians, chain)


@pytest.mark.parametrize(("free", "radial"), [([], False), ([1], False), ([0, 2], False), ([0, 2], True)])
def test_step_and_gradient_are_those_of_dense_matrices(free, radial):
    rng = np.random.default_rng(0)
    n, camera, free = 7, np.array([0, 1, 2, 0, 1, 2, 1]), np.array(free, dtype=int)
    pairs = np.array([[0, 1], [2, 1], [2, 3], [3, 4], [5, 4], [6, 5], [0, 6], [1, 0]])
    triplets = np.array([[0, 1, 2], [3, 2, 1], [6, 0, 3], [5, 4, 3]])
    terms = [random_terms(images, rng, with_focals=len(free) > 0, with_radial=radial) for images in (pairs, triplets)]
    system = NormalSystem(n, [pairs, triplets], camera, free, 3, with_radial=radial)
    size = 6 * n + len(free) + radial
    H, g = np.zeros((size, size)), np.zeros(size)
    for term in terms:
        for k, images in enumerate(term.images):
            place = [6 * i + a for i in images for a in range(6)]
            slots = [6 * n + list(free).index(camera[i]) if camera[i] in free else -1 for i in images]
            slots = [*slots, size - 1] if radial else slots[: term.lens_gradients.shape[1]]
            whole = np.block(
                [[term.pose_blocks[k], term.cross_blocks[k]], [term.cross_blocks[k].T, term.lens_blocks[k]]]
            )
            local = np.concatenate([term.pose_gradients[k], term.lens_gradients[k]])
            for a, row in enumerate(place + slots):
                for b, column in enumerate(place + slots):
                    if row >= 0 and column >= 0:
                        H[row, column] += whole[a, b]
                if row >= 0:
                    g[row] += local[a]
    np.testing.assert_allclose(system.gradient(terms), g, rtol=1e-12, atol=1e-12)
    damping = 0.1
    diagonal = np.diag(H).copy()
    level = damping * diagonal
    level[: 6 * n] += MIN_DAMPING * np.tile(diagonal[: 6 * n].reshape(n, 6).max(axis=0), n)
    expected = -np.linalg.solve(H + np.diag(level), g)
    np.testing.assert_allclose(system.step(terms, g, damping), expected, rtol=1e-8, atol=1e-12)


def test_chain_carries_derivatives_to_cameras():
    rng = np.random.default_rng(1)
    images = np.array([[0, 1, 2], [2, 1, 0]])
    gradients, J = rng.standard_normal((2, 15)), rng.standard_normal((2, 50, 15))
    hessians, chain = np.einsum("qka,qkb->qab", J, J), rng.standard_normal((2, 12, 18))
    term = CameraTerms.chained(images, np.ones(2), gradients, hessians, chain)
    for k in range(2):
        whole = np.zeros((15, 21))
        whole[:12, :18], whole[12:, 18:] = chain[k], np.eye(3)
        full = whole.T @ hessians[k] @ whole
        np.testing.assert_allclose(term.pose_blocks[k], full[:18, :18])
        np.testing.assert_allclose(term.cross_blocks[k], full[:18, 18:])
        np.testing.assert_allclose(term.lens_blocks[k], full[18:, 18:])
        np.testing.assert_allclose(
            np.concatenate([term.pose_gradients[k], term.lens_gradients[k]]), gradients[k] @ whole
        )
