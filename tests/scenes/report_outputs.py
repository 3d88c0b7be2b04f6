"""Finished jobs to make reports of: a small real one with hostile names, and a large one that is only written."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from synthetic_databases import changed_copy, make_database

from colmap_vg.cli.jobs import mapper
from colmap_vg.cli.reporter import Reporter
from colmap_vg.jobs.verdict_tables import ImageRow, PairRow, VerdictTables, write_tables
from colmap_vg.options import MappingOptions

HOSTILE_NAMES = (
    "<script>alert(1)</script>.jpg",
    "\"quoted\" 'twice' </textarea> &amp; {{ 7*7 }}.jpg",
    "x" * 200 + "/" + "y" * 96 + ".jpg",  # 301 characters
    "Größe 日本 \u2028 \u202e.jpg",
    "two\nlines.jpg",
    "<img src=x onerror=alert(1)>",
)


def page_data(page: str) -> Any:
    """The data in a report's page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def hostile_job(folder: Path) -> Path:
    """The output folder of a mapping job on ten images, six of which have hostile names and two photographs."""
    make_database(folder / "original.db", num_points=300, noise_px=0.5)
    renamed = [
        ("UPDATE images SET name = ? WHERE image_id = ?", (name, row + 1)) for row, name in enumerate(HOSTILE_NAMES)
    ]
    database = changed_copy(folder / "original.db", folder / "database.db", *renamed)
    photographs = folder / "photographs"
    photographs.mkdir()
    _, encoded = cv2.imencode(".jpg", np.full((768, 1024, 3), (40, 90, 200), np.uint8))
    for name in (HOSTILE_NAMES[3], HOSTILE_NAMES[4]):
        (photographs / name).write_bytes(encoded.tobytes())
    mapper(database, photographs, folder / "out", MappingOptions(), False, Reporter(quiet=True), with_report=False)
    return folder / "out"


def two_models_job(folder: Path) -> Path:
    """The output folder of a mapping job on twelve images, no pair of which links the first six with the others."""
    make_database(folder / "original.db", num_images=12, num_points=300, noise_px=0.5)
    first, second = "pair_id / 2147483647", "pair_id % 2147483647"
    cut = f"DELETE FROM {{}} WHERE ({first} <= 6) != ({second} <= 6)"
    database = changed_copy(
        folder / "original.db",
        folder / "database.db",
        *((cut.format(table), ()) for table in ("two_view_geometries", "matches")),
    )
    mapper(database, None, folder / "out", MappingOptions(), False, Reporter(quiet=True), with_report=False)
    return folder / "out"


def large_job(output: Path, num_images: int = 500, num_points: int = 100_000) -> Path:
    """An output folder with a model of many images and points, photographs, and 20 pairs per image."""
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=1200, height=800, params=[1000, 1000, 600, 400])
    model.add_camera_with_trivial_rig(camera)
    names = [f"street {row:04d}.jpg" for row in range(num_images)]
    per_image = 3 * num_points // num_images
    for row, name in enumerate(names):
        image = pycolmap.Image(name=name, camera_id=1, image_id=row + 1)
        image.points2D = [pycolmap.Point2D(xy) for xy in rng.uniform(0, 800, (per_image, 2))]
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(), [-0.2 * row, 0.0, 0.0]))
    used = np.zeros(num_images, dtype=int)
    for point in range(num_points):
        track = pycolmap.Track()
        for row in (np.arange(3) + point) % num_images:
            track.add_element(int(row) + 1, int(used[row]))
            used[row] += 1
        place = rng.normal([0.2 * (point % num_images), 0.0, 8.0], 2.0)
        model.add_point3D(place, track, rng.integers(0, 255, 3).astype(np.uint8))
    (output / "0").mkdir(parents=True)
    model.write(output / "0")
    (output / "images").mkdir()
    for name in names:
        _, encoded = cv2.imencode(".jpg", rng.integers(0, 255, (80, 120, 3)).astype(np.uint8))
        (output / "images" / name).write_bytes(encoded.tobytes())
    images = [ImageRow(name, "0", "registered", 20, 19, "0.1", "0.01") for name in names]
    pairs = [
        PairRow(name, names[(row + step) % num_images], "kept", str(900 // step), f"{rng.exponential():.3f}", "0.500")
        for row, name in enumerate(names)
        for step in range(1, 51)
    ]
    write_tables(output, VerdictTables(tuple(images), tuple(pairs)))
    summary = {
        "verb": "mapper",
        "version": "0",
        "options": {},
        "stages": [],
        "seconds": 1.0,
        "peak_memory_mib": 1.0,
        "warnings": [],
        "status": "solved",
        "edges": {"num_edges": len(pairs), "num_kept": len(pairs), "dropped": {}},
    }
    (output / "summary.json").write_text(json.dumps(summary))
    return output
