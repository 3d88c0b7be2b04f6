"""From a folder of photographs to models: feature extraction, matching and mapping, with resume.

The database is built at ``OUT/.work/database.db`` and renamed to ``OUT/database.db`` when it is finished, so a database
in the output folder is always complete. ``OUT/.work/features.json`` records the files and options it was made from.
"""

import json
import sqlite3
from collections.abc import Callable
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from colmap_vg.errors import OutputError
from colmap_vg.events import StageEvent, StageLog
from colmap_vg.features.extraction import UNREADABLE, FeatureResult, check_photographs
from colmap_vg.features.isolated import extract_features_apart, match_features_apart
from colmap_vg.features.photographs import SkippedFile
from colmap_vg.features.rigs import configure_rigs, wants_rigs, with_rig_cameras
from colmap_vg.features.staging import readable_folder
from colmap_vg.jobs.atomic_write import atomic_write
from colmap_vg.jobs.mapper import view_graph_mapping
from colmap_vg.jobs.output_folder import WORK_NAME, lock_descriptors, output_lock, refuse_models, work_folder
from colmap_vg.options import FeatureOptions, MappingOptions

if TYPE_CHECKING:
    import pycolmap

DATABASE_NAME = "database.db"
RECORD_NAME = "features.json"
COPIES_NAME = "copies"


def image_folder_mapping(
    image_path: str | PathLike[str],
    output_path: str | PathLike[str],
    features: FeatureOptions | None = None,
    options: MappingOptions | None = None,
    on_event: Callable[[StageEvent], None] | None = None,
) -> "dict[int, pycolmap.Reconstruction]":
    """Make models from a folder of photographs: features, matching, viewing graph, triangulation, bundle adjustment.

    Parameters
    ----------
    image_path : path
        Folder of photographs, searched recursively.
    output_path : path
        Folder for ``database.db`` and the models ``0``, ``1``, ...
    features : FeatureOptions, optional
    options : MappingOptions, optional
        With ``overwrite``, existing models and an existing database are replaced.
    on_event : callable, optional
        Called with a `StageEvent` whenever a stage starts, progresses, ends or warns.

    Returns
    -------
    dict of int to pycolmap.Reconstruction
        The models, as written, the largest first.

    Raises
    ------
    ColmapVgError
        The folder or its photographs cannot be used, the output cannot be written, or no model could be made.
    """
    options = MappingOptions.given(options)
    with output_lock(output_path):
        make_database(image_path, output_path, features, StageLog(on_event), overwrite=options.overwrite)
        database_path = Path(output_path) / DATABASE_NAME
        return view_graph_mapping(database_path, image_path, output_path, options, on_event=on_event)


def make_database(
    image_path: str | PathLike[str],
    output_path: str | PathLike[str],
    options: FeatureOptions | None = None,
    log: StageLog | None = None,
    *,
    overwrite: bool = False,
    resume: bool = False,
) -> FeatureResult:
    """Make ``output_path/database.db`` from a folder of photographs.

    Parameters
    ----------
    image_path, output_path : path
    options : FeatureOptions, optional
    log : StageLog, optional
    overwrite : bool
        Accept an output folder that holds models, and replace a database that was not made by this function.
    resume : bool
        Reuse a finished database, or continue an unfinished one, if it was made from the same photographs with the
        same options; otherwise warn and start again.

    Returns
    -------
    FeatureResult

    Raises
    ------
    ImageFolderError
        The photographs cannot be used.
    OutputError
        The output cannot be written, or holds models or a database that this function did not make.
    """
    options, log = with_rig_cameras(FeatureOptions.given(options)), log or StageLog()
    refuse_models(output_path, overwrite)
    finished, record_path = Path(output_path) / DATABASE_NAME, Path(output_path) / WORK_NAME / RECORD_NAME
    if finished.exists() and not record_path.exists() and not overwrite:
        raise OutputError(
            f"{finished} already exists and was not made by this job: map it with "
            f"view_graph_mapping, choose another output_path, or replace it with overwrite=True"
        )
    output = Path(output_path).resolve()
    inside = [output] if Path(image_path).resolve() in output.parents else []
    photographs, skipped = check_photographs(image_path, options, log, inside)
    names = [photograph.name for photograph in photographs]
    with work_folder(output_path, overwrite) as work:
        record, unfinished = _record(image_path, names, options), work / DATABASE_NAME
        same = resume and _read_record(record_path) == record
        if same and finished.exists():
            log.progress(f"reusing {finished}")
            known = set(image_names(finished))
            skipped += [SkippedFile(name, UNREADABLE) for name in names if name not in known]
            readable = tuple(name for name in names if name in known)
            return FeatureResult(readable, tuple(skipped), _num_verified(finished))
        if resume and record_path.exists() and not same:
            log.warn(f"{work} was made from other photographs or with other options: features are extracted again")
        if same and unfinished.exists() and not _is_whole(unfinished):
            log.warn(f"{unfinished} is damaged: features are extracted again")
            same = False
        if not same:
            _remove_previous(finished, unfinished, record_path, record)
        with readable_folder(image_path, photographs, options, work / COPIES_NAME) as (folder, reading):
            names, unreadable = extract_features_apart(folder, unfinished, names, reading, log, lock_descriptors())
        _configure_rigs(unfinished, options, log)
        num_verified_pairs = match_features_apart(unfinished, options, log, lock_descriptors())
        try:
            unfinished.replace(finished)
        except OSError as error:
            raise OutputError(f"cannot write {finished}: {error.strerror}; choose another output_path") from error
        return FeatureResult(tuple(names), (*skipped, *unreadable), num_verified_pairs)


def _configure_rigs(database_path: Path, options: FeatureOptions, log: StageLog) -> None:
    if wants_rigs(options):
        with log.stage("rigs"):
            log.result(configure_rigs(database_path, options))


def _remove_previous(finished: Path, unfinished: Path, record_path: Path, record: dict[str, object]) -> None:
    """Remove the database of an earlier job and write a new record.

    The old record is removed first, so that a job killed in between leaves nothing that seems complete.
    """
    try:
        record_path.unlink(missing_ok=True)
        for path in (finished, *unfinished.parent.glob(f"{DATABASE_NAME}*")):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot write to {record_path.parent}: {error.strerror}; choose another output_path"
        ) from error
    atomic_write(record_path, json.dumps(record, indent=1))


def _record(image_path: str | PathLike[str], names: list[str], options: FeatureOptions) -> dict[str, object]:
    """Record what a database depends on: files with sizes and times, and all options but those without an effect."""
    folder = Path(image_path)
    files = [(name, (folder / name).stat()) for name in names]
    kept = {key: value for key, value in asdict(options).items() if key not in ("num_threads", "image_list_path")}
    kept["mask_path"] = None if options.mask_path is None else str(Path(options.mask_path).resolve())
    kept["rig_config_path"] = (
        None if options.rig_config_path is None else Path(options.rig_config_path).read_text("utf-8")
    )
    record = {
        "image_path": str(folder.resolve()),
        "files": [[name, status.st_size, status.st_mtime_ns] for name, status in files],
        "options": kept,
    }
    normal: dict[str, object] = json.loads(json.dumps(record))  # tuples become lists, as in a record read from a file
    return normal


def _read_record(path: Path) -> object:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def image_names(database_path: Path) -> list[str]:
    """Names of a database's images in the order of their ids, read without changing the file.

    Raises
    ------
    OutputError
        The file is damaged.
    """
    return [str(row[0]) for row in _query(database_path, "SELECT name FROM images ORDER BY image_id")]


def _is_whole(database_path: Path) -> bool:
    """Whether the pages of a database are consistent; an empty file counts as one without tables."""
    try:
        return _query(database_path, "PRAGMA quick_check(1)") == [("ok",)]
    except OutputError:
        return False


def _num_verified(database_path: Path) -> int:
    return int(_query(database_path, "SELECT count(*) FROM two_view_geometries WHERE rows > 0")[0][0])


def _query(database_path: Path, statement: str) -> list[tuple[str | int, ...]]:
    """Query a database without pycolmap, which changes every database that it opens."""
    # Without "immutable", reading a database in COLMAP's WAL mode leaves -wal and -shm files beside it.
    mode = "mode=ro" if Path(f"{database_path}-wal").exists() else "mode=ro&immutable=1"
    connection = sqlite3.connect(f"{database_path.resolve().as_uri()}?{mode}", uri=True)
    try:
        return connection.execute(statement).fetchall()
    except sqlite3.DatabaseError as error:
        raise OutputError(f"{database_path} is damaged ({error}): run again without resume=True") from error
    finally:
        connection.close()
