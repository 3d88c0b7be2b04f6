"""Global Structure-from-Motion on the viewing graph, as a plugin for pycolmap.

The public names are loaded when first used, so that the numerics import without pycolmap.
"""

import zlib  # noqa: F401  -- must come before pycolmap, whose bundled zlib otherwise breaks the process's own
from importlib import import_module
from typing import TYPE_CHECKING

from colmap_vg._version import __version__

_HOME = {
    "CancelledError": "errors",
    "ColmapVgError": "errors",
    "EdgeVerdict": "scene.verdicts",
    "FeatureOptions": "options",
    "ImageVerdict": "scene.verdicts",
    "MappingOptions": "options",
    "PosePriors": "scene.pose_priors",
    "PoseSolution": "scene.solution",
    "ReadOptions": "options",
    "Rigs": "scene.rigs",
    "Similarity": "geometry.similarity",
    "SolutionStatus": "scene.verdicts",
    "SolveOptions": "options",
    "ViewGraph": "scene.view_graph",
    "align_positions": "geometry.similarity",
    "export_model": "exports.export",
    "image_folder_mapping": "jobs.image_folder",
    "read_1dsfm": "datasets.one_dsfm_folder",
    "read_bundle": "datasets.bundle",
    "read_view_graph": "reading.read",
    "solve_view_graph": "solver.solve",
    "view_graph_mapping": "jobs.mapper",
}

if TYPE_CHECKING:
    from colmap_vg.datasets.bundle import read_bundle
    from colmap_vg.datasets.one_dsfm_folder import read_1dsfm
    from colmap_vg.errors import CancelledError, ColmapVgError
    from colmap_vg.exports.export import export_model
    from colmap_vg.geometry.similarity import Similarity, align_positions
    from colmap_vg.jobs.image_folder import image_folder_mapping
    from colmap_vg.jobs.mapper import view_graph_mapping
    from colmap_vg.options import FeatureOptions, MappingOptions, ReadOptions, SolveOptions
    from colmap_vg.reading.read import read_view_graph
    from colmap_vg.scene.pose_priors import PosePriors
    from colmap_vg.scene.rigs import Rigs
    from colmap_vg.scene.solution import PoseSolution
    from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict, SolutionStatus
    from colmap_vg.scene.view_graph import ViewGraph
    from colmap_vg.solver.solve import solve_view_graph

__all__ = [
    "CancelledError",
    "ColmapVgError",
    "EdgeVerdict",
    "FeatureOptions",
    "ImageVerdict",
    "MappingOptions",
    "PosePriors",
    "PoseSolution",
    "ReadOptions",
    "Rigs",
    "Similarity",
    "SolutionStatus",
    "SolveOptions",
    "ViewGraph",
    "__version__",
    "align_positions",
    "export_model",
    "image_folder_mapping",
    "read_1dsfm",
    "read_bundle",
    "read_view_graph",
    "solve_view_graph",
    "view_graph_mapping",
]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'colmap_vg' has no attribute {name!r}")
    value = getattr(import_module(f"colmap_vg.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
