"""Anderson acceleration: sooner than the plain iteration, to the same point, and no slower where it does not serve."""

import numpy as np

from colmap_vg.linear.anderson import fixed_point


def _iterate(step, start, accelerate, limit=20_000):
    return fixed_point(
        step, start, accelerate=accelerate, max_num_iterations=limit, tolerance=1e-10, on_iteration=lambda *_: None
    )


def test_a_slow_linear_iteration_ends_early():
    rng = np.random.default_rng(0)
    turn, _ = np.linalg.qr(rng.standard_normal((20, 20)))
    matrix, target = turn @ np.diag(np.linspace(0.0, 0.995, 20)) @ turn.T, rng.standard_normal(20)

    def step(x):
        return target + matrix @ (x - target)

    plain, plain_count, plain_done = _iterate(step, np.zeros(20), False)
    fast, fast_count, fast_done = _iterate(step, np.zeros(20), True)
    assert plain_done
    assert fast_done
    assert np.abs(fast - target).max() < 1e-7
    assert np.abs(plain - target).max() < 1e-7
    assert fast_count < plain_count / 10


def test_where_mixing_does_not_serve_plain_steps_take_over():
    rng = np.random.default_rng(0)
    kinks = rng.uniform(-1.0, 1.0, 40)

    def step(x):  # piecewise linear with a kink at every turn: secants say little
        return 0.5 * np.abs(np.roll(x, 1) - kinks) - 0.45 * np.abs(x + kinks)

    plain, plain_count, plain_done = _iterate(step, 3.0 * rng.standard_normal(40), False)
    fast, fast_count, fast_done = _iterate(step, 3.0 * rng.standard_normal(40), True)
    assert plain_done
    assert fast_done
    assert np.abs(plain - fast).max() < 1e-8
    assert fast_count <= plain_count + 60
