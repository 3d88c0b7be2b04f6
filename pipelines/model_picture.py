"""Picture of the model and viewing graph of a finished job: ``python pipelines/model_picture.py OUT picture.png``.

Points, cameras, and the pairs between them: grey pairs were used, orange ones were not. `docs/images/model.png` is
that of ``colmap-vg demo``, with ``--turn_deg 60``.
"""

import argparse
import csv
from pathlib import Path

import colmap_vg  # before pycolmap: it keeps zlib working

# isort: split
import numpy as np
import pycolmap
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

Array = NDArray[np.float64]

USED, NOT_USED, CAMERA = "#8a94a3", "#e8710a", "#1f4e8c"
FRUSTUM = 0.07
"""Depth of a camera's frustum, as a share of the largest distance of cameras from their middle."""


def view_axes(rotations: Array, tilt_deg: float, turn_deg: float) -> Array:
    """Axes (3, 3) of a view from above: right, up and towards the viewer, in the world frame."""
    up = -rotations[:, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    right = np.linalg.svd(up[None])[2][1]
    back = np.cross(right, up)
    turn, tilt = np.radians([turn_deg, tilt_deg])
    right, back = np.cos(turn) * right + np.sin(turn) * back, np.cos(turn) * back - np.sin(turn) * right
    return np.stack([right, np.cos(tilt) * up - np.sin(tilt) * back, np.sin(tilt) * up + np.cos(tilt) * back])


def frusta(rotations: Array, centers: Array, aspect: float, depth: float) -> Array:
    """Lines (8 n, 2, 3) of the cameras' pyramids: four edges from the centre and four around the image."""
    corners = depth * np.array([[-0.5, -0.5, 1], [0.5, -0.5, 1], [0.5, 0.5, 1], [-0.5, 0.5, 1]]) * [1, aspect, 1]
    places = centers[:, None] + np.einsum("nba,kb->nka", rotations, corners)
    apexes = np.broadcast_to(centers[:, None], places.shape)
    sides = np.stack([places, np.roll(places, -1, axis=1)], axis=2)
    return np.concatenate([np.stack([apexes, places], axis=2), sides], axis=1).reshape(-1, 2, 3)


def draw(output_path: Path, picture_path: Path, tilt_deg: float, turn_deg: float) -> None:
    """Draw model 0 of a finished job."""
    model = pycolmap.Reconstruction(output_path / "0")
    images = [model.image(image_id) for image_id in sorted(model.reg_image_ids())]
    rotations = np.stack([image.cam_from_world().rotation.matrix() for image in images])
    centers = np.stack([image.projection_center() for image in images])
    row = {image.name: k for k, image in enumerate(images)}
    with (output_path / "pairs.csv").open(newline="", encoding="utf-8") as file:
        pairs = [pair for pair in csv.DictReader(file) if pair["image1"] in row and pair["image2"] in row]
    ends = np.array([[centers[row[pair["image1"]]], centers[row[pair["image2"]]]] for pair in pairs])
    used = np.array([pair["verdict"] in ("kept", "rotation_only") for pair in pairs])
    points = np.stack([point.xyz for point in model.points3D.values()])
    colors = np.stack([point.color for point in model.points3D.values()]) / 255.0

    middle = centers.mean(axis=0)
    radius = np.linalg.norm(centers - middle, axis=1).max()
    axes = view_axes(rotations, tilt_deg, turn_deg)
    near = np.linalg.norm(points - middle, axis=1) < 1.5 * radius
    seen = (points[near] - middle) @ axes.T
    order = np.argsort(seen[:, 2])
    camera = images[0].camera
    lines = frusta(rotations, centers, camera.height / camera.width, FRUSTUM * radius)

    figure = Figure(figsize=(8, 4.4), layout="constrained")
    plot = figure.add_subplot()
    plot.set_axis_off()
    plot.set_aspect("equal")
    plot.scatter(*seen[order, :2].T, s=1.6, c=colors[near][order], linewidths=0)
    for of_kind, color, width in ((used, USED, 0.6), (~used, NOT_USED, 1.1)):
        plot.add_collection(LineCollection((ends[of_kind] - middle) @ axes[:2].T, colors=color, linewidths=width))
    plot.add_collection(LineCollection((lines - middle) @ axes[:2].T, colors=CAMERA, linewidths=1.1))
    shown = np.concatenate(
        [((lines - middle) @ axes[:2].T).reshape(-1, 2), np.quantile(seen[:, :2], [0.005, 0.995], axis=0)]
    )
    low, high = shown.min(axis=0), shown.max(axis=0)
    plot.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    figure.savefig(picture_path, dpi=110, bbox_inches="tight")
    if picture_path.suffix == ".png":
        Image.open(picture_path).convert("RGB").quantize(64).save(picture_path, optimize=True)


def main() -> None:
    """Run the script."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output_path", type=Path, help="folder of a finished job")
    parser.add_argument("picture_path", type=Path, help="PNG, SVG or PDF file to write")
    parser.add_argument("--tilt_deg", type=float, default=30.0, help="angle of the view above the horizon")
    parser.add_argument("--turn_deg", type=float, default=0.0, help="turn of the view about the vertical")
    arguments = parser.parse_args()
    try:
        draw(arguments.output_path, arguments.picture_path, arguments.tilt_deg, arguments.turn_deg)
    except (OSError, ValueError, colmap_vg.ColmapVgError) as error:
        parser.exit(1, f"error: {error}\n")


if __name__ == "__main__":
    main()
