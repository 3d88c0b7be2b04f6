"""Models against their pairs' rotations: who is contradicted, which parts nothing confirms, and what leaves."""

import numpy as np
import pycolmap
import pytest
from synthetic_databases import PINHOLE

from colmap_vg.events import StageLog
from colmap_vg.geometry import so3
from colmap_vg.mapping import build
from colmap_vg.mapping.pair_agreement import PairRotations, pair_agreement


def make_model(num_images: int) -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1,
            num_frames_per_rig=num_images,
            num_points3D=50,
            camera_model_id=pycolmap.CameraModelId.SIMPLE_PINHOLE,
            camera_params=list(PINHOLE[1]),
        )
    )


def pairs_of(model: pycolmap.Reconstruction, turned: dict[tuple[int, int], float]) -> PairRotations:
    """All pairs, some of them turned by an angle in degrees."""
    ids = sorted(model.reg_image_ids())
    R = {i: model.image(i).cam_from_world().rotation.matrix() for i in ids}
    pairs = [(a, b) for a in ids for b in ids if a < b]
    axis = np.array([0.6, 0.0, 0.8])
    rotations = [so3.exp(np.radians(turned.get(p, 0.0)) * axis[None])[0] @ R[p[1]] @ R[p[0]].T for p in pairs]
    return PairRotations(np.array(pairs), np.array(rotations), np.full(len(pairs), 100.0))


def test_a_true_model_is_confirmed() -> None:
    model = make_model(6)
    small = {(1, 2): 10.0, (3, 5): 14.0}
    found = pair_agreement(model, pairs_of(model, small))
    assert found.contradicted == frozenset()
    assert found.detached == ()


def test_an_image_whose_pairs_tell_another_rotation_is_named() -> None:
    model = make_model(6)
    false = {(k, 4): 40.0 for k in (1, 2, 3)} | {(4, 5): 90.0}
    assert pair_agreement(model, pairs_of(model, false)).contradicted == {4}
    # By matches, not by number.
    pairs = pairs_of(model, false)
    weak = np.where((pairs.image_ids == 4).any(axis=1) & (pairs.image_ids != 6).all(axis=1), 10.0, 100.0)
    reweighed = PairRotations(pairs.image_ids, pairs.cam2_from_cam1_rotations, weak)
    assert pair_agreement(model, reweighed).contradicted == frozenset()


def test_parts_that_no_pair_joins_are_detached() -> None:
    model = make_model(7)
    false = {(a, b): 60.0 for a in (1, 2, 3, 4) for b in (5, 6, 7)}
    assert pair_agreement(model, pairs_of(model, false)).detached == (frozenset({5, 6, 7}),)
    log = StageLog()
    with log.stage("register"):
        build._warn_of_folds(model, pairs_of(model, false), log)
    assert any("3 images" in warning and "folded" in warning for warning in log.warnings)


def test_images_outside_the_model_and_models_without_pairs_say_nothing() -> None:
    model = make_model(4)
    pairs = pairs_of(model, {})
    model.deregister_frame(model.image(4).frame_id)
    assert pair_agreement(model, pairs).contradicted == frozenset()
    none = PairRotations(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3, 3)), np.zeros(0))
    assert pair_agreement(model, none).detached == ()


@pytest.mark.parametrize("added", [set(), {4}])
def test_only_images_that_came_by_points_leave(added: set[int]) -> None:
    class Mapper:
        reconstruction = make_model(6)
        observation_manager = reconstruction  # deregisters by frame, too

    false = {(k, 4): 40.0 for k in (1, 2, 3)} | {(4, 5): 90.0, (4, 6): 30.0}
    assert build._remove_misplaced(Mapper(), added, pairs_of(Mapper.reconstruction, false)) == added
    assert (4 in Mapper.reconstruction.reg_image_ids()) == (not added)
