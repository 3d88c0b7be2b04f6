"""Sessions of the explorer: marks change the solution as the saved lists change the next job's."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from report_outputs import HOSTILE_NAMES, hostile_job

from colmap_vg import MappingOptions, ReadOptions, align_positions, solve_view_graph
from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.reporter import Reporter
from colmap_vg.colmap_io.pair_lists import read_pair_list
from colmap_vg.errors import DataFileError, OutputError
from colmap_vg.jobs.graph import solve_options
from colmap_vg.simulation.database import write_synthetic_database
from colmap_vg.simulation.views import synthetic_views
from colmap_vg.viewer.drawing import EXCLUDED, drawing, side_by_side_shift
from colmap_vg.viewer.finished_job import FinishedJob, read_finished_job
from colmap_vg.viewer.session import Session


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return hostile_job(tmp_path_factory.mktemp("hostile"))


@pytest.fixture(scope="module")
def job(output: Path) -> FinishedJob:
    return read_finished_job(output)


def test_a_session_starts_with_the_solution_of_the_job_in_its_frame(job: FinishedJob) -> None:
    session = Session(job)
    assert session.before is session.after
    assert session.before.registered.all()
    radius = np.linalg.norm(np.ptp(job.centers, axis=0))
    # The job's model is bundle adjusted, and the session's solution is not.
    assert np.linalg.norm(session.before.projection_centers - job.centers, axis=1).max() < 0.01 * radius
    found = session.comparison()
    assert len(found.lost) == len(found.gained) == len(found.moved) == 0


def test_an_excluded_image_is_lost_and_comes_back(job: FinishedJob) -> None:
    session = Session(job)
    session.exclude_image(0)
    found = session.solve()
    assert found.lost.tolist() == [0]
    assert session.after.image_verdicts[0] == "no_edges"
    assert np.nanmax(found.shifts) < 1.0
    assert any(line.startswith("lost: <script>alert(1)</script>.jpg: no verified pair") for line in session.told())
    session.exclude_image(0, False)
    assert session.solve().lost.tolist() == []
    np.testing.assert_allclose(session.after.projection_centers, session.before.projection_centers, atol=1e-9)


def test_a_trusted_pair_is_used_whatever_filters_say(tmp_path: Path) -> None:
    views = synthetic_views("drone", 16, noise_px=0.5)
    write_synthetic_database(tmp_path / "database.db", views)
    mapper(tmp_path / "database.db", None, tmp_path / "out", MappingOptions(), False, Reporter(quiet=True), False)
    session = Session(read_finished_job(tmp_path / "out"))
    false = {tuple(pair) for pair in views.pairs[views.wrong].tolist()}
    dropped = next(k for k, pair in enumerate(session.job.graph.edges.tolist()) if tuple(pair) in false)
    assert not session.before.edge_kept[dropped]
    session.trust_pair(dropped)
    session.solve()
    assert session.after.edge_kept[dropped]


def test_marks_exclude_each_other(job: FinishedJob) -> None:
    session = Session(job)
    session.trust_pair(3)
    session.exclude_pair(3)
    assert (session.excluded[3], session.trusted[3]) == (True, False)
    session.trust_pair(3)
    assert (session.excluded[3], session.trusted[3]) == (False, True)
    session.clear_pair(3)
    assert (session.excluded[3], session.trusted[3]) == (False, False)
    session.exclude_pair(2)
    session.exclude_image(1)
    session.clear()
    assert not session.all_excluded.any()


def test_saved_lists_give_the_next_job_the_same_result(job: FinishedJob, tmp_path: Path) -> None:
    """With names that hold newlines, quotes, tabs, 300 characters and markup."""
    session = Session(job)
    session.exclude_image(4)  # two lines
    for pair in range(0, job.graph.num_edges, 7):
        session.exclude_pair(pair)
    session.trust_pair(job.graph.num_edges - 1)
    session.solve()
    excluded, trusted = session.save(tmp_path / "lists")
    names = job.graph.image_names
    marked = {frozenset(names[k] for k in job.graph.edges[row]) for row in np.flatnonzero(session.all_excluded)}
    assert {frozenset(pair) for pair in read_pair_list(excluded)} == marked
    assert len(read_pair_list(trusted)) == 1
    options = MappingOptions(read=ReadOptions(excluded_pairs_path=excluded, trusted_pairs_path=trusted))
    mapper(job.database_path, None, tmp_path / "out", options, False, Reporter(quiet=True), with_report=False)
    again = read_finished_job(tmp_path / "out")
    np.testing.assert_array_equal(again.excluded, session.all_excluded)
    np.testing.assert_array_equal(again.trusted, session.trusted & ~session.all_excluded)
    solved = Session(again).before
    np.testing.assert_array_equal(solved.edge_verdicts, session.after.edge_verdicts)
    np.testing.assert_array_equal(solved.registered, session.after.registered)
    rows = solved.registered
    errors, _ = align_positions(solved.projection_centers[rows], session.after.projection_centers[rows])
    assert errors.max() < 1e-9
    model = pycolmap.Reconstruction(tmp_path / "out" / "0")
    assert {model.image(i).name for i in model.reg_image_ids()} == {names[k] for k in np.flatnonzero(rows)}
    shown = json.loads((tmp_path / "out" / "summary.json").read_text())["edges"]["dropped"]
    assert shown["excluded"] == session.all_excluded.sum()


def test_solving_again_uses_the_options_of_the_job(output: Path, tmp_path: Path) -> None:
    summary = json.loads((output / "summary.json").read_text())
    summary["options"]["mapping"]["solve"]["method"] = "2C"
    for name in ("images.csv", "pairs.csv"):
        (tmp_path / name).write_text((output / name).read_text())
    (tmp_path / "0").symlink_to(output / "0")
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    job = read_finished_job(tmp_path)
    assert job.options.solve.method == "2C"
    expected = solve_view_graph(job.graph, solve_options(job.options))
    errors, _ = align_positions(Session(job).before.projection_centers, expected.projection_centers)
    assert errors.max() < 1e-9


@pytest.mark.parametrize("fault", ["option", "no database", "no summary"])
def test_jobs_that_cannot_be_explored_are_told(output: Path, tmp_path: Path, fault: str) -> None:
    summary = json.loads((output / "summary.json").read_text())
    error: type[Exception] = OutputError
    if fault == "option":
        summary["options"]["mapping"]["solve"]["colour"] = "red"
    if fault == "no database":
        summary["options"]["database_path"], error = str(tmp_path / "gone.db"), DataFileError
    if fault != "no summary":
        (tmp_path / "summary.json").write_text(json.dumps(summary))
    with pytest.raises(error):
        read_finished_job(tmp_path)


def test_drawings_show_marks_and_frusta(job: FinishedJob) -> None:
    session = Session(job)
    session.exclude_pair(0)
    session.solve()
    before, after = drawing(session, session.before), drawing(session, session.after)
    assert len(before.images) == job.graph.num_images
    row = after.pairs.tolist().index(0)
    assert after.segment_colors[row, 0].tolist() == list(EXCLUDED)
    assert not after.used[row]
    i, j = job.graph.edges[0]
    np.testing.assert_allclose(after.segments[row], session.after.projection_centers[[i, j]])
    # world_from_cam: the optical axis of each camera points to where it sees the points.
    towards = job.points.mean(axis=0) - before.centers
    assert (np.einsum("ka,ka->k", before.rotations[:, :, 2], towards) > 0).all()
    shift = side_by_side_shift(before, after)
    assert np.linalg.norm(shift) > 0
    assert HOSTILE_NAMES[0] in job.graph.image_names
