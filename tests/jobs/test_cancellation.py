"""Jobs that are cancelled from another thread: no model, nothing unfinished, and a process that goes on."""

import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from rendered_corner import render_corner
from synthetic_databases import make_database, sha256

import colmap_vg
from colmap_vg import events
from colmap_vg.errors import CancelledError, ColmapVgError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.jobs.image_folder import make_database as database_of_photographs
from colmap_vg.options import FeatureOptions, MappingOptions

STAGES = ["view graph", "solve", "load", "triangulate", "adjust", "register", "check", "write"]
OPTIONS = MappingOptions(num_threads=1)


@pytest.fixture(scope="module")
def database_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / "database.db"
    make_database(path, num_images=5, num_points=80, noise_px=0.5)
    return path


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, database_path: Path) -> dict[str, np.ndarray]:
    output = tmp_path_factory.mktemp("undisturbed")
    return poses(colmap_vg.view_graph_mapping(database_path, None, output, OPTIONS)[0])


def poses(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    return {image.name: image.cam_from_world().matrix() for image in model.images.values()}


def cancelled_in(stage: str, state: str, database_path: Path, output: Path) -> list[BaseException]:
    """Run a job in a thread, and cancel it from this one when it comes to an event; return what it raised."""
    reached, stop, raised = threading.Event(), threading.Event(), list[BaseException]()

    def on_event(event: StageEvent) -> None:
        if (event.stage, event.state) == (stage, state):
            reached.set()
            stop.wait(timeout=30)
        if stop.is_set():
            raise CancelledError("the user closed the window")

    def job() -> None:
        try:
            colmap_vg.view_graph_mapping(database_path, None, output, OPTIONS, on_event)
        except CancelledError as error:
            raised.append(error)

    worker = threading.Thread(target=job)
    worker.start()
    assert reached.wait(timeout=30)
    stop.set()
    worker.join(timeout=30)
    assert not worker.is_alive()
    return raised


@pytest.mark.parametrize(("stage", "state"), [*((stage, "started") for stage in STAGES), ("write", "progress")])
def test_a_cancelled_job_leaves_nothing(
    stage: str, state: str, database_path: Path, undisturbed: dict[str, np.ndarray], tmp_path: Path
) -> None:
    before, level = sha256(database_path), pycolmap.logging.minloglevel
    (error,) = cancelled_in(stage, state, database_path, tmp_path / "made" / "out")
    assert str(error) == "the user closed the window"
    assert list(tmp_path.iterdir()) == []
    assert [path.name for path in database_path.parent.iterdir()] == ["database.db"]
    assert sha256(database_path) == before
    assert pycolmap.logging.minloglevel == level
    again = poses(colmap_vg.view_graph_mapping(database_path, None, tmp_path / "made" / "out", OPTIONS)[0])
    assert again.keys() == undisturbed.keys()
    for name, pose in again.items():
        np.testing.assert_array_equal(pose, undisturbed[name])


def test_models_that_were_there_stay(database_path: Path, tmp_path: Path) -> None:
    colmap_vg.view_graph_mapping(database_path, None, tmp_path, OPTIONS)
    before = {path: sha256(path) for path in tmp_path.rglob("*") if path.is_file()}

    def on_event(event: StageEvent) -> None:
        if event.stage == "write" and event.state == "progress":
            raise CancelledError

    with pytest.raises(CancelledError):
        colmap_vg.view_graph_mapping(
            database_path, None, tmp_path, MappingOptions(num_threads=1, overwrite=True), on_event
        )
    assert {path: sha256(path) for path in tmp_path.rglob("*") if path.is_file()} == before


def test_any_other_exception_is_passed_on_as_it_is(database_path: Path, tmp_path: Path) -> None:
    class CallersError(Exception):
        pass

    def on_event(event: StageEvent) -> None:
        if event.stage == "adjust":
            raise CallersError

    with pytest.raises(CallersError):
        colmap_vg.view_graph_mapping(database_path, None, tmp_path / "out", OPTIONS, on_event)
    assert list(tmp_path.iterdir()) == []
    assert not issubclass(CancelledError, ColmapVgError)


def test_long_stages_report_between_their_steps(
    database_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "MIN_INTERVAL", 0.0)
    seen: list[StageEvent] = []
    colmap_vg.view_graph_mapping(database_path, None, tmp_path, OPTIONS, seen.append)
    counts = Counter(event.stage for event in seen if event.state == "progress")
    assert counts["view graph"] > 20
    assert counts["solve"] > 20
    assert counts["adjust"] >= 3


def test_finished_features_are_kept_for_resuming(tmp_path: Path) -> None:
    photos, output = tmp_path / "photos", tmp_path / "out"
    render_corner(4).write(photos)
    features = FeatureOptions(max_num_features=300, max_image_size=240, num_threads=1)

    def on_event(event: StageEvent) -> None:
        if event.stage == "matching":
            raise CancelledError

    with pytest.raises(CancelledError):
        colmap_vg.image_folder_mapping(photos, output, features, OPTIONS, on_event)
    assert sorted(path.name for path in output.iterdir()) == [".work"]
    seen: list[StageEvent] = []
    made = database_of_photographs(photos, output, features, StageLog(seen.append), resume=True)
    assert len(made.image_names) == 4
    counts = {event.count for event in seen if event.stage == "features" and event.state == "progress"}
    assert counts <= {None, 4}, "features were extracted again"
