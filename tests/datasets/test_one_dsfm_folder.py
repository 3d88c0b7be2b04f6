"""1DSfM readers against folders written from known cameras, and triplets of the real set."""

import numpy as np
import pytest

import colmap_vg
from colmap_vg.datasets.one_dsfm_folder import BUNDLER_FROM_COLMAP_AXES
from colmap_vg.geometry import so3
from colmap_vg.geometry.directions import normalized
from colmap_vg.simulation.ring_scenes import ring_scene

F = BUNDLER_FROM_COLMAP_AXES


def _write_folder(folder, scene):
    """The files as their authors' documentation describes them, from Bundler-style cameras F R."""
    R = F @ scene.cam_from_world_rotations
    p = scene.projection_centers
    lines = []
    for i, j in scene.graph.edges:
        t = R[i] @ (p[j] - p[i])
        lines.append(
            " ".join(map(repr, [int(i), int(j), *(R[i] @ R[j].T).ravel().tolist(), *(t / np.linalg.norm(t)).tolist()]))
        )
    (folder / "EGs.txt").write_text("\n".join(lines) + "\n")
    (folder / "cc.txt").write_text("\n".join(str(k) for k in range(len(p))) + "\n")
    (folder / "list.txt").write_text("".join(f"images/{k}.jpg 0 {700 + k}\n" for k in range(len(p))))
    bundle = ["# Bundle file v0.3", f"{len(p) + 1} 0"]
    for k in range(len(p)):
        bundle += [
            "800 0 0",
            *(" ".join(map(repr, row)) for row in R[k].tolist()),
            " ".join(map(repr, (-R[k] @ p[k]).tolist())),
        ]
    bundle += ["0 0 0", "0 0 0", "0 0 0", "0 0 0", "0 0 0"]
    (folder / "gt_bundle.out").write_text("\n".join(bundle) + "\n")


def test_graph_and_truth_agree_in_colmap_axes(tmp_path):
    scene = ring_scene(8, 3)
    _write_folder(tmp_path, scene)
    graph, truth = colmap_vg.read_1dsfm(tmp_path), colmap_vg.read_bundle(tmp_path / "gt_bundle.out")
    assert sorted(truth) == list(range(8))
    R = np.array([truth[k][0] for k in range(8)])
    p = np.array([truth[k][1] for k in range(8)])
    np.testing.assert_allclose(R, scene.cam_from_world_rotations, atol=1e-12)
    np.testing.assert_allclose(p, scene.projection_centers, atol=1e-12)
    np.testing.assert_allclose(graph.cam2_from_cam1_rotations, scene.graph.cam2_from_cam1_rotations, atol=1e-12)
    np.testing.assert_allclose(graph.cam2_in_cam1_directions, scene.graph.cam2_in_cam1_directions, atol=1e-12)
    assert graph.image_names[3] == "images/3.jpg"


def test_edges_outside_the_component_are_left_out(tmp_path):
    _write_folder(tmp_path, ring_scene(8, 3))
    (tmp_path / "cc.txt").write_text("0\n1\n2\n3\n")
    graph = colmap_vg.read_1dsfm(tmp_path)
    assert graph.image_ids.tolist() == [0, 1, 2, 3]
    assert graph.edges.max() <= 3


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("0 1 1 0 0 0 1 0 0 0 1 0 0", "13 values, expected 14"),
        ("0 1 1 0 0 0 1 0 0 0 x 0 0 1", "could not convert"),
        ("0 1 1 0 0 0 1 0 0 0 nan 0 0 1", "NaN"),
        ("0 1 2 0 0 0 1 0 0 0 1 0 0 1", "no rotation"),
        ("0 1 1 0 0 0 1 0 0 0 1 0 0 0", "zero translation"),
        ("2 2 1 0 0 0 1 0 0 0 1 0 0 1", "itself"),
        ("0 -1 1 0 0 0 1 0 0 0 1 0 0 1", "negative"),
    ],
)
def test_bad_rows_are_named_by_file_and_line(tmp_path, line, complaint):
    good = "0 1 1 0 0 0 1 0 0 0 1 0 0 1"
    (tmp_path / "EGs.txt").write_text(f"# a comment\n{good}\n\n{line}\n")
    with pytest.raises(colmap_vg.ColmapVgError, match=rf"EGs\.txt:4: .*{complaint}"):
        colmap_vg.read_1dsfm(tmp_path)


def test_missing_and_cut_files(tmp_path):
    with pytest.raises(colmap_vg.ColmapVgError, match="cannot be read"):
        colmap_vg.read_1dsfm(tmp_path)
    (tmp_path / "b.out").write_text("# Bundle file v0.3\n1 0\n800 0 0\n1 0 0\n")
    with pytest.raises(colmap_vg.ColmapVgError, match="middle of the cameras"):
        colmap_vg.read_bundle(tmp_path / "b.out")
    (tmp_path / "b.out").write_text("# Bundle file v0.3\n1 0\n800 0 0\n1 0 0\n0 1 0\n0 0 2\n0 0 0\n")
    with pytest.raises(colmap_vg.ColmapVgError, match=r"b\.out:4: .*not a rotation"):
        colmap_vg.read_bundle(tmp_path / "b.out")


def _triplets(edges, num):
    """Rows of edges (a, b), (b, c), (a, c) of random triangles a < b < c."""
    index = {tuple(e): k for k, e in enumerate(edges.tolist())}
    neighbors: dict[int, list[int]] = {}
    for a, b in index:
        neighbors.setdefault(a, []).append(b)
    found = [
        (k, index[b, c], index[a, c]) for (a, b), k in index.items() for c in neighbors.get(b, []) if (a, c) in index
    ]
    return np.random.default_rng(0).permutation(np.array(found))[:num].T


@pytest.mark.real_data
def test_triplets_of_real_edges_compose_in_our_order_and_not_in_the_other(data_folder):
    graph = colmap_vg.read_1dsfm(data_folder / "view_graphs" / "1dsfm_madrid_metropolis")
    first, second, whole = (graph.cam2_from_cam1_rotations[k] for k in _triplets(graph.edges, 20_000))
    inverse = np.swapaxes(whole, 1, 2)
    ours, other = so3.angle(second @ first @ inverse), so3.angle(first @ second @ inverse)
    assert np.mean(ours < 0.05) > 2.0 * np.mean(other < 0.05)


@pytest.mark.real_data
def test_directions_of_real_triangles_close_with_the_rotations(data_folder):
    """The directions of a triangle lie in one plane in the right frame, and not with the rotation transposed."""
    graph = colmap_vg.read_1dsfm(data_folder / "view_graphs" / "1dsfm_madrid_metropolis")
    first, second, whole = _triplets(graph.edges, 20_000)
    R, g = graph.cam2_from_cam1_rotations[first], graph.cam2_in_cam1_directions
    normal = normalized(np.cross(g[first], g[whole]))
    ours = np.abs(np.einsum("ka,kba,kb->k", normal, R, g[second]))
    other = np.abs(np.einsum("ka,kab,kb->k", normal, R, g[second]))
    assert np.mean(ours < 0.05) > 1.3 * np.mean(other < 0.05)
