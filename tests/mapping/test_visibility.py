"""Samples of a model's tracks."""

import numpy as np
import pycolmap

from colmap_vg.mapping.visibility import MIN_TRACK_LENGTH, sampled_tracks


def make_model() -> pycolmap.Reconstruction:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=6, num_points3D=40, track_length=4)
    return pycolmap.synthesize_dataset(options)


def test_tracks_are_those_of_the_points() -> None:
    model = make_model()
    ids = sorted(model.reg_image_ids())
    found = sampled_tracks(model, ids)
    tracks = {
        tuple(np.round(point.xyz, 9)): {element.image_id for element in point.track.elements}
        for point in model.points3D.values()
    }
    tracks = {xyz: seen for xyz, seen in tracks.items() if len(seen) >= MIN_TRACK_LENGTH}
    assert found.num_observations == sum(map(len, tracks.values()))
    assert len(found.points) == len(tracks)
    for xyz, sees in zip(found.points, found.sees, strict=True):
        assert {image_id for image_id, saw in zip(ids, sees, strict=True) if saw} == tracks[tuple(np.round(xyz, 9))]
    assert (np.diff(found.sees.sum(axis=1)) >= 0).all()
    assert len(sampled_tracks(model, ids, 10).points) == 10


def test_an_image_that_sees_a_point_twice_counts_once() -> None:
    model = make_model()
    ids = sorted(model.reg_image_ids())
    before = sampled_tracks(model, ids)
    for point_id in sorted(model.points3D)[:20]:
        image_id = model.point3D(point_id).track.elements[0].image_id
        free = next(k for k, p in enumerate(model.image(image_id).points2D) if not p.has_point3D())
        model.add_observation(point_id, pycolmap.TrackElement(image_id, free))
        if point_id % 10 == 0:
            break
    after = sampled_tracks(model, ids)
    assert after.num_observations == before.num_observations
    np.testing.assert_array_equal(after.sees, before.sees)
