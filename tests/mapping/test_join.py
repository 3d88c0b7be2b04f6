"""The similarity between two models from the points that pairs between them identify."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from colmap_vg import read_view_graph
from colmap_vg.mapping.join import joint_of


@pytest.mark.parametrize(
    ("first", "second"), [(range(1, 6), range(6, 11)), (range(1, 7), range(5, 11)), (range(5, 11), range(1, 7))]
)
def test_models_that_share_no_or_some_images_have_a_joint(first: range, second: range, tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_frames_per_rig=10, num_points3D=60)
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
    graph = read_view_graph(tmp_path / "database.db")
    models = []
    for kept in (first, second):
        model = pycolmap.Reconstruction(truth)
        for image_id in set(range(1, 11)) - set(kept):
            model.deregister_frame(model.image(image_id).frame_id)
        model.tear_down()  # without the images of the other
        assert sorted(model.images) == list(kept)
        models.append(model)
    usable = np.isin(graph.image_ids[graph.edges], (5, 6)).any(axis=1)
    joint = joint_of(*models, graph, usable, seed=0)
    assert joint.num_agreeing == joint.num_shared > 50
    assert joint.similarity is not None
    assert joint.similarity.scale == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(joint.similarity.translation, 0.0, atol=1e-9)
