"""The bundle adjustment of COLMAP models: Ceres' minimum, for every lens, and nothing else in the model changes."""

import numpy as np
import pycolmap
import pytest

from colmap_vg.bundle.adjustment import adjust
from colmap_vg.colmap_io.model_observations import ModelObservations
from colmap_vg.geometry.similarity import align_positions
from colmap_vg.mapping.bundle_problem import ColmapLens, ModelProblem, has_rigs
from colmap_vg.mapping.options import bundle_options
from colmap_vg.options import MappingOptions

OPTIONS = MappingOptions(num_threads=1)
SCALE_PX = 1.0


def noisy_model() -> pycolmap.Reconstruction:
    """Twelve images by three cameras, with noise of keypoints, poses and points."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=3, num_cameras_per_rig=1, num_frames_per_rig=4, num_points3D=300
    )
    model = pycolmap.synthesize_dataset(options)
    pycolmap.synthesize_noise(
        pycolmap.SyntheticNoiseOptions(
            rig_from_world_translation_stddev=0.02,
            rig_from_world_rotation_stddev=0.3,
            point3D_stddev=0.02,
            point2D_stddev=0.7,
        ),
        model,
    )
    return model


def with_ids_backwards(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model with the ids of its images in reverse order, and its cameras as they were."""
    found, last = pycolmap.Reconstruction(), max(model.images) + 1
    for camera in model.cameras.values():
        found.add_camera_with_trivial_rig(pycolmap.Camera(camera.todict()))
    for image_id, image in model.images.items():
        keypoints = np.array([keypoint.xy for keypoint in image.points2D])
        copy = pycolmap.Image(image.name, keypoints, image.camera_id, last - image_id)
        found.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        elements = [pycolmap.TrackElement(last - e.image_id, e.point2D_idx) for e in point.track.elements]
        found.add_point3D(point.xyz, pycolmap.Track(elements))
    return found


def problem_of(
    model: pycolmap.Reconstruction,
    options: MappingOptions,
    min_track_length: int = 3,
    held: frozenset[int] = frozenset(),
) -> ModelProblem | None:
    return ModelProblem.of(model, ModelObservations.of(model), options, min_track_length, held)


def by_ceres(model: pycolmap.Reconstruction, options: MappingOptions) -> tuple[float, float]:
    """Adjust a model by Ceres to its end; return the costs before and after."""
    asked = bundle_options(options, loss_scale_px=SCALE_PX)
    asked.ceres.solver_options.function_tolerance = 1e-12
    asked.ceres.solver_options.max_num_iterations = 200
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    summary = pycolmap.create_default_bundle_adjuster(asked, config, model).solve().ceres_summary
    return summary.initial_cost, summary.final_cost


@pytest.mark.parametrize(
    "options",
    [
        OPTIONS,
        MappingOptions(num_threads=1, ba_refine_focal_length=False, ba_refine_extra_params=False),
        MappingOptions(num_threads=1, ba_refine_principal_point=True),
    ],
)
def test_it_ends_at_the_minimum_that_ceres_finds(options: MappingOptions) -> None:
    model, reference = noisy_model(), noisy_model()
    initial, final = by_ceres(reference, options)
    problem = problem_of(model, options, 3)
    assert problem is not None
    found = adjust(problem.problem, problem.state, SCALE_PX, tolerance=1e-3)
    assert found.initial_cost == pytest.approx(initial, rel=1e-9)
    assert found.final_cost == pytest.approx(final, rel=1e-5)
    assert found.final_cost < 0.9 * initial
    problem.write(found.state, model)
    centers = [
        np.array([each.image(i).projection_center() for i in sorted(each.reg_image_ids())])
        for each in (model, reference)
    ]
    errors, _ = align_positions(*centers)
    assert errors.max() < 1e-3 * np.ptp(centers[1])
    for camera_id, camera in reference.cameras.items():
        np.testing.assert_allclose(model.camera(camera_id).params, camera.params, rtol=1e-2, atol=1e-2)


def test_the_state_of_a_model_is_written_back_as_it_was() -> None:
    model, before = noisy_model(), noisy_model()
    problem = problem_of(model, OPTIONS, 3)
    assert problem is not None
    problem.write(problem.state, model)
    for image_id, image in before.images.items():
        np.testing.assert_allclose(
            model.image(image_id).cam_from_world().matrix(), image.cam_from_world().matrix(), atol=1e-12
        )
    for point_id, point in before.points3D.items():
        np.testing.assert_array_equal(model.point3D(point_id).xyz, point.xyz)
    assert {k: list(c.params) for k, c in model.cameras.items()} == {
        k: list(c.params) for k, c in before.cameras.items()
    }


def test_images_are_in_the_order_of_their_cameras_and_short_tracks_are_left_out() -> None:
    model = with_ids_backwards(noisy_model())
    short = sorted(model.points3D)[::4]
    for point_id in short:
        elements = [(e.image_id, e.point2D_idx) for e in model.point3D(point_id).track.elements]
        for image_id, place in elements[2:]:
            model.delete_observation(image_id, place)
    problem = problem_of(model, OPTIONS, 3)
    assert problem is not None
    cameras = [model.image(i).camera_id for i in problem.image_ids]
    assert cameras == sorted(cameras)
    assert problem.image_ids != sorted(problem.image_ids)
    assert (np.diff(problem.problem.image_row) >= 0).all()
    assert [problem.camera_ids[k] for k in problem.problem.camera_idx] == cameras
    assert problem.point_ids == [point_id for point_id in sorted(model.points3D) if point_id not in short]
    assert len(problem.problem.image_row) == sum(model.point3D(i).track.length() for i in problem.point_ids)
    for image, point, keypoint in zip(
        problem.problem.image_row[::50], problem.problem.point_row[::50], problem.problem.keypoints[::50], strict=True
    ):
        seen = [p for p in model.image(problem.image_ids[image]).points2D if p.point3D_id == problem.point_ids[point]]
        assert keypoint.tolist() in [p.xy.tolist() for p in seen]


def test_a_model_without_long_tracks_has_no_problem() -> None:
    assert problem_of(noisy_model(), OPTIONS, 100) is None
    assert problem_of(pycolmap.Reconstruction(), OPTIONS, 3) is None


@pytest.mark.parametrize(
    ("refine", "free"),
    [
        ((True, False, True), [0, 1, 4, 5, 6, 7]),
        ((True, False, False), [0, 1]),
        ((False, True, False), [2, 3]),
        ((False, False, False), []),
    ],
)
def test_the_parameters_that_are_asked_for_are_free(refine: tuple[bool, bool, bool], free: list[int]) -> None:
    camera = pycolmap.Camera(model="OPENCV", width=100, height=80, params=[90, 91, 50, 40, 0.1, 0.02, 0.001, 0.002])
    focal, principal, extra = refine
    options = MappingOptions(
        ba_refine_focal_length=focal, ba_refine_principal_point=principal, ba_refine_extra_params=extra
    )
    lens = ColmapLens(camera, options)
    assert lens.free.tolist() == free
    assert lens.focal.tolist() == [place in (0, 1) for place in free]
    rays = np.array([[0.1, 0.2, 1.0], [0.0, 0.0, -1.0]])
    projected = lens.project(np.array(camera.params), rays)
    np.testing.assert_allclose(projected[0], camera.img_from_cam(rays)[0])
    assert np.isnan(projected[1]).all()
    assert list(camera.params) == [90, 91, 50, 40, 0.1, 0.02, 0.001, 0.002]


def test_rigs_are_recognised() -> None:
    assert not has_rigs(noisy_model())
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=3, num_points3D=20)
    assert has_rigs(pycolmap.synthesize_dataset(options))


def test_held_frames_keep_their_poses_lenses_and_points() -> None:
    model = noisy_model()
    for point_id in sorted(model.points3D)[::2]:
        elements = [(e.image_id, e.point2D_idx) for e in model.point3D(point_id).track.elements]
        for image_id, place in elements:
            if image_id > 7:
                model.delete_observation(image_id, place)
    held_images = sorted(model.reg_image_ids())[:5]
    frames = frozenset(model.image(i).frame_id for i in held_images)
    cameras = {model.image(i).camera_id for i in held_images}
    before = pycolmap.Reconstruction(model)
    problem = problem_of(model, OPTIONS, 3, frames)
    assert problem is not None
    found = adjust(problem.problem, problem.state, SCALE_PX)
    assert found.final_cost < found.initial_cost
    problem.write(found.state, model)
    for image_id, image in before.images.items():
        moved = model.image(image_id).projection_center() - image.projection_center()
        assert (np.linalg.norm(moved) < 1e-12) == (image_id in held_images)
    for camera_id, camera in before.cameras.items():
        assert (list(model.camera(camera_id).params) == list(camera.params)) == (camera_id in cameras)
    num_moved = 0
    for point_id, point in before.points3D.items():
        others = sum(e.image_id not in held_images for e in point.track.elements)
        stays = bool(np.array_equal(model.point3D(point_id).xyz, point.xyz))
        assert stays or 2 * others >= point.track.length()
        num_moved += not stays
    assert 100 < num_moved < 200


def test_points_that_only_held_frames_see_are_left_out() -> None:
    model = noisy_model()
    frames = frozenset(model.image(i).frame_id for i in sorted(model.reg_image_ids())[:11])
    last = max(model.reg_image_ids())
    for point_id in sorted(model.points3D)[::3]:
        element = next(e for e in model.point3D(point_id).track.elements if e.image_id == last)
        model.delete_observation(last, element.point2D_idx)
    seen_by_last = {p.point3D_id for p in model.image(last).get_observation_points2D()}
    problem = problem_of(model, OPTIONS, 3, frames)
    assert problem is not None
    assert set(problem.point_ids) == seen_by_last
    # They are fixed, so what held images see of them tells nothing.
    assert len(problem.problem.image_row) == len(seen_by_last) == 200
