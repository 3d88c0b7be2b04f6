"""The data of the report as JSON that is safe inside a script element."""

import json
from base64 import b64encode
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_vg.report.contents import Contents
from colmap_vg.report.models import ModelView
from colmap_vg.scene.verdicts import USED_EDGES, EdgeVerdict, ImageVerdict

_ESCAPES = {ord(character): f"\\u{ord(character):04x}" for character in "<>&\u2028\u2029"}


def payload(contents: Contents) -> dict[str, Any]:
    """Return the data of the page's scripts as JSON's types; tables are stored by columns."""
    rows = {row.image: index for index, row in enumerate(contents.images)}
    pairs = [(pair, rows.get(pair.image1, -1), rows.get(pair.image2, -1)) for pair in contents.pairs]
    return {
        "images": {
            "name": [row.image for row in contents.images],
            "model": [row.model for row in contents.images],
            "verdict": [row.verdict for row in contents.images],
            "pairs": [row.num_pairs for row in contents.images],
            "kept": [row.num_kept_pairs for row in contents.images],
            "position_sigma": [_number(row.position_sigma_percent) for row in contents.images],
            "rotation_sigma": [_number(row.rotation_sigma_deg) for row in contents.images],
            "photograph": list(contents.photographs),
        },
        "pairs": {
            "a": [a for _, a, _ in pairs],
            "b": [b for _, _, b in pairs],
            "verdict": [pair.verdict for pair, _, _ in pairs],
            "inliers": [_number(pair.num_inliers) for pair, _, _ in pairs],
            "rotation": [_number(pair.rotation_error_deg) for pair, _, _ in pairs],
            "direction": [_number(pair.direction_error_deg) for pair, _, _ in pairs],
            "sigmas": [_number(pair.sigmas) for pair, _, _ in pairs],
        },
        "imageReasons": {word: ImageVerdict.reason_of(word) for word in {row.verdict for row in contents.images}},
        "pairReasons": {word: EdgeVerdict.reason_of(word) for word in {pair.verdict for pair in contents.pairs}},
        "used": list(USED_EDGES),
        "models": [_model(view) for view in contents.models],
        "matches": {str(pair): np.round(match, 4).tolist() for pair, match in contents.matches.items()},
    }


def script_json(data: object) -> str:
    """JSON in ASCII that contains no character with a meaning in HTML."""
    return json.dumps(data, separators=(",", ":"), allow_nan=False, sort_keys=True).translate(_ESCAPES)


def _model(view: ModelView) -> dict[str, Any]:
    colored = bool(view.colors.any())
    return {
        "name": view.name,
        "images": view.images.tolist(),
        "centers": _rounded(view.centers),
        "corners": _rounded(view.corners),
        "points": _packed(view.points, "<f4"),
        "colors": _packed(view.colors, "u1") if colored else "",
        "numPoints": view.num_points,
        "low": _rounded(view.low),
        "high": _rounded(view.high),
        "errorEdges": _rounded(view.error_edges),
        "errorCounts": view.error_counts.tolist(),
        "trackCounts": view.track_counts.tolist(),
    }


def _packed(array: NDArray[Any], dtype: str) -> str:
    return b64encode(np.ascontiguousarray(array, dtype=dtype).tobytes()).decode("ascii")


def _rounded(array: NDArray[np.float64]) -> Any:
    return np.round(array, 5).tolist()


def _number(text: str) -> float | None:
    return float(text) if text else None
