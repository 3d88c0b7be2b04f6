"""Object-like graphs: true pairs are true, false ones have the shares, the precision and the coherence they claim."""

import numpy as np
import pytest

from colmap_vg.errors import OptionError
from colmap_vg.geometry import so3
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.simulation.objects import FALSE_SHARES, ObjectNoise, object_scene


def test_true_pairs_agree_with_the_truth_and_false_ones_do_not():
    scene = object_scene(80, 2500, seed=1)
    graph = scene.graph
    residuals = rotation_residuals(graph.edges, graph.cam2_from_cam1_rotations, scene.cam_from_world_rotations)
    assert np.degrees(np.quantile(residuals[~scene.outlier], 0.99)) < 5.0
    assert (np.degrees(residuals[scene.outlier]) > 10.0).mean() > 0.95


@pytest.mark.parametrize("hardness", [0.0, 1.0])
def test_shares_of_false_pairs_by_number_of_inliers(hardness):
    scenes = [object_scene(100, 4000, ObjectNoise(hardness=hardness), seed) for seed in range(5)]
    inliers = np.concatenate([s.graph.num_inliers for s in scenes])
    false = np.concatenate([s.outlier for s in scenes])
    starts = [row[0] for row in FALSE_SHARES]
    for start, end, (_, low, high) in zip(starts, [*starts[1:], np.inf], FALSE_SHARES, strict=True):
        share = false[(inliers >= start) & (inliers < end)].mean()
        assert abs(share - (high if hardness else low)) < 0.03


def test_false_pairs_state_as_much_information_as_true_ones():
    scene = object_scene(100, 4000, seed=2)
    information = np.log(scene.graph.edge_information[:, 0, 0])
    assert abs(np.median(information[scene.outlier]) - np.median(information[~scene.outlier])) < 0.1


def test_coherent_false_pairs_agree_on_few_turns():
    noise = ObjectNoise(hardness=1.0, coherent_share=1.0, rotation_deg=1e-5)
    scene = object_scene(80, 2000, noise, seed=3)
    (i, j), R = scene.graph.edges[scene.outlier].T, scene.cam_from_world_rotations
    # The turn of the world that takes each second image to where its pair sees it.
    turns = np.swapaxes(R[j], 1, 2) @ scene.graph.cam2_from_cam1_rotations[scene.outlier] @ R[i]
    angles = np.degrees(so3.angle(turns))
    other = np.median(angles[angles < 179.0])
    shares = [(np.abs(angles - turn) < 0.1).mean() for turn in (180.0, other)]
    assert min(shares) > 0.1
    assert sum(shares) > 0.6  # the rest found no look-alike to stand for


def test_focal_error_scales_rotations():
    exact, scaled = (
        object_scene(40, 300, ObjectNoise(rotation_deg=1e-5, focal_error=error), seed=4) for error in (0.0, 0.02)
    )
    ratio = so3.angle(scaled.graph.cam2_from_cam1_rotations) / so3.angle(exact.graph.cam2_from_cam1_rotations)
    assert np.allclose(ratio, 1.02, atol=1e-5)


@pytest.mark.parametrize(("num_images", "num_edges"), [(5, 100), (50, 100), (20, 500)])
def test_impossible_sizes_are_refused(num_images, num_edges):
    with pytest.raises(OptionError, match="object_scene"):
        object_scene(num_images, num_edges)
