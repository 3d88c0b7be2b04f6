"""What one scene adds to the tables and figures: its solutions measured against the truth, as plain numbers.

Each scene is measured by itself (:func:`measure_scene`), in any process; what it found is kept as a file of numbers, so
that a long job can be taken up again.
"""

import hashlib
import json
from dataclasses import asdict, astuple, dataclass, fields
from os import PathLike
from pathlib import Path

import numpy as np
from benchmark.rotation_averaging import averaged_by_pycolmap
from numpy.typing import NDArray

from colmap_vg._version import __version__
from colmap_vg.options import Method
from paper.figures import EdgeErrors, edge_errors, scale_factors
from paper.position_table import MethodErrors, solve_with, with_shared_medians
from paper.scenes import KnownScene, real_scene, set_conditions, simulated_scene

Array = NDArray[np.float64]

SCALE_BINS = np.linspace(-2.0, 2.0, 81)
"""log10 of scale factor over length."""
ERROR_BINS = np.linspace(0.0, 180.0, 61)
"""Degrees."""
CONVERGED_LOG_RATIO = 0.01
"""|log10 lambda / length| below which scale factor and length agree."""


@dataclass(frozen=True)
class SceneJob:
    """One scene to be measured.

    Attributes
    ----------
    dataset : str
        Set of the topology folder, or name of the 1DSfM folder.
    folder : str
        The topology folder, or the 1DSfM folder itself.
    seed : int or None
        None for real edges.
    methods : tuple of str
    """

    dataset: str
    folder: str
    seed: int | None
    methods: tuple[Method, ...]

    def scene(self) -> KnownScene:
        """Read or simulate the scene."""
        if self.seed is None:
            return real_scene(self.folder)
        return simulated_scene(self.folder, self.dataset, self.seed)

    @property
    def key(self) -> str:
        """Name of its file of numbers: another for any other input, option, version, noise or field."""
        conditions = None if self.seed is None else set_conditions(self.folder, self.dataset)
        told = json.dumps(
            [
                __version__,
                asdict(self),
                conditions and [conditions[0], asdict(conditions[1])],
                [field.name for kind in (SceneReport, MethodErrors) for field in fields(kind)],
            ]
        )
        return f"{self.dataset}-{self.seed}-{hashlib.sha256(told.encode()).hexdigest()[:12]}.json"


@dataclass(frozen=True)
class SceneReport:
    """What one scene adds to the tables and figures: plain numbers.

    Attributes
    ----------
    rows : tuple of MethodErrors
    scale_counts : dict of "CLS" or "1C" to list of int
        Edges in :data:`SCALE_BINS`; those beyond are in the outermost.
    cls_share_at_one : float
        Edges whose scale factor CLS leaves at exactly 1.
    alg_1c_share_off : float
        Edges whose scale factor differs from the length by a hundredth of a decade or more in 1C.
    error_counts : dict of name to list of int
        Edges in :data:`ERROR_BINS`, by rotation and direction, all and kept.
    num_edges : int
        Of the whole graph.
    averaging_seconds : float
        Of ``pycolmap.run_rotation_averaging`` on the whole graph; NaN where it registers no image.
    """

    rows: tuple[MethodErrors, ...]
    scale_counts: dict[str, list[int]]
    cls_share_at_one: float
    alg_1c_share_off: float
    error_counts: dict[str, list[int]]
    num_edges: int
    averaging_seconds: float


def measure_scene(job: SceneJob) -> SceneReport:
    """Solve a scene by all methods of its job and count what the figures show.

    Raises
    ------
    ColmapVgError
        The scene's files are missing or bad, or the scene cannot be solved.
    """
    scene, seed = job.scene(), job.seed or 0
    averaged, averaging_seconds = averaged_by_pycolmap(scene.graph)
    solved = {method: solve_with(scene, method, seed) for method in job.methods}
    front, _ = solved["cls"] if "cls" in solved else solve_with(scene, "cls", seed)
    factors = scale_factors(scene.graph, front)
    return SceneReport(
        with_shared_medians(scene, solved),
        {"CLS": _counts(factors.cls, SCALE_BINS), "1C": _counts(factors.alg_1c, SCALE_BINS)},
        factors.cls_share_at_one,
        float(np.mean(np.abs(factors.alg_1c) >= CONVERGED_LOG_RATIO)),
        _error_counts(edge_errors(scene, front)),
        scene.graph.num_edges,
        averaging_seconds if averaged.num_reg_images() else float("nan"),
    )


def measure_or_load(job: SceneJob, work: str | PathLike[str], resume: bool) -> SceneReport:
    """:func:`measure_scene`, kept in a folder; with `resume`, taken from there where it is."""
    path = Path(work) / job.key
    if resume and path.exists():
        found = json.loads(path.read_text(encoding="utf-8"))
        return SceneReport(tuple(MethodErrors(*row) for row in found.pop("rows")), **found)
    report = measure_scene(job)
    kept = {**asdict(report), "rows": [astuple(row) for row in report.rows]}
    draft = path.with_suffix(".draft")
    draft.write_text(json.dumps(kept), encoding="utf-8")
    draft.replace(path)
    return report


def _error_counts(errors: EdgeErrors) -> dict[str, list[int]]:
    counts = {}
    for what, values in (("rotation", errors.rotation_deg), ("direction", errors.direction_deg)):
        known = np.isfinite(values)
        counts[f"{what} before"] = _counts(values[known], ERROR_BINS)
        counts[f"{what} after"] = _counts(values[known & errors.kept], ERROR_BINS)
    return counts


def _counts(values: Array, bins: Array) -> list[int]:
    inside = np.clip(values, bins[0], bins[-1])
    return [int(count) for count in np.histogram(inside, bins)[0]]
