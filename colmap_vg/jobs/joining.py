"""Join the models of a job whose shared points agree on the similarity between them."""

from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.colmap_io.loading import loaded_reconstruction
from colmap_vg.colmap_io.raw_matches import compared_pairs
from colmap_vg.events import StageLog
from colmap_vg.mapping.build import BuildResult, build_model
from colmap_vg.mapping.georeference import Georeference
from colmap_vg.mapping.join import Joint, joined_poses, joint_of
from colmap_vg.mapping.pair_agreement import PairRotations
from colmap_vg.mapping.weak_cuts import cut_along
from colmap_vg.options import MappingOptions
from colmap_vg.scene.verdicts import EdgeVerdict
from colmap_vg.scene.view_graph import ViewGraph


@dataclass(frozen=True)
class BuiltModel:
    """A finished model and the result of building it."""

    reconstruction: "pycolmap.Reconstruction"
    result: BuildResult
    georeference: Georeference | None = None


def join_models(
    cache: "pycolmap.DatabaseCache",
    models: list[BuiltModel],
    graph: ViewGraph,
    usable: NDArray[np.bool_],
    pairs: PairRotations,
    compared: NDArray[np.int64],
    options: MappingOptions,
    log: StageLog,
) -> list[BuiltModel]:
    """Join models whose shared points agree on the similarity between them, while the joined model is consistent."""
    refused: set[frozenset[int]] = set()
    while True:
        with log.stage("join"):
            models = sorted(models, key=lambda model: -model.reconstruction.num_reg_images())
            first, second, joint = _best_joint(models, graph, usable, refused, options.random_seed)
            if joint.similarity is None:
                log.result("one model" if len(models) == 1 else f"{len(models)} models, none of which can be joined")
                return models
            own, other = models[first].reconstruction, models[second].reconstruction
            log.result(
                f"models of {own.num_reg_images()} and {other.num_reg_images()} images share {joint.num_shared} points,"
                f" {joint.num_agreeing} of which agree on the similarity between them"
            )
        posed = joined_poses(loaded_reconstruction(cache), own, other, joint.similarity)
        both, moved = set(posed.reg_image_ids()), set(other.reg_image_ids())
        elsewhere = frozenset(
            i for k, m in enumerate(models) if k not in (first, second) for i in m.reconstruction.reg_image_ids()
        )
        posed, result = build_model(cache, posed, options, log, elsewhere, pairs)
        cut = cut_along(posed, pairs, compared, moved)
        if both <= set(posed.reg_image_ids()) and not result.folded and not cut.contradicted:
            rest = [model for k, model in enumerate(models) if k not in (first, second)]
            models = [*rest, BuiltModel(posed, result)]
            continue
        refused.add(frozenset(own.reg_image_ids()) | frozenset(moved))
        log.warn(
            f"Models of {own.num_reg_images()} and {len(moved)} images share points, but are not joined: adjusted"
            f" together they lose {len(both - set(posed.reg_image_ids()))} images, and both see a share of"
            f" {cut.share_seen:.2f} of the points that both should see ({cut.share_seen_elsewhere:.2f} elsewhere)."
        )


def compared_images(database_path: str | PathLike[str], graph: ViewGraph) -> NDArray[np.int64]:
    """Image ids (k, 2) of the pairs that were compared, without those that the user excluded."""
    pairs = np.sort(compared_pairs(database_path), axis=1)
    if graph.read_verdicts is None:
        return pairs
    excluded = np.sort(graph.image_ids[graph.edges[graph.read_verdicts == EdgeVerdict.EXCLUDED]], axis=1)
    known = set(map(tuple, excluded.tolist()))
    return np.array([pair for pair in pairs.tolist() if tuple(pair) not in known], dtype=np.int64).reshape(-1, 2)


def _best_joint(
    models: Sequence[BuiltModel],
    graph: ViewGraph,
    usable: NDArray[np.bool_],
    refused: set[frozenset[int]],
    seed: int,
) -> tuple[int, int, Joint]:
    """The two models with the most shared points that agree on a similarity; `Joint.similarity` is None without any."""
    best = 0, 0, Joint(0, 0, None)
    for a, one in enumerate(models):
        for b in range(a + 1, len(models)):
            own, other = one.reconstruction, models[b].reconstruction
            if frozenset(own.reg_image_ids()) | frozenset(other.reg_image_ids()) in refused:
                continue
            joint = joint_of(own, other, graph, usable, seed)
            if joint.similarity is not None and joint.num_agreeing > best[2].num_agreeing:
                best = a, b, joint
    return best
