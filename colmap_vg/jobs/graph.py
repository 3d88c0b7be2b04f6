"""Read and solve the viewing graph of a job with the options of its mapping."""

from dataclasses import replace
from os import PathLike

import numpy as np
import pycolmap

from colmap_vg.events import StageLog
from colmap_vg.mapping.extension import check_image_names
from colmap_vg.options import MappingOptions, ReadOptions, SolveOptions
from colmap_vg.reading.found_lenses import FoundLenses
from colmap_vg.reading.read import read_with_caveats
from colmap_vg.scene.pose_priors import PosePriors
from colmap_vg.scene.solution import PoseSolution
from colmap_vg.scene.view_graph import ViewGraph
from colmap_vg.solver.solve import solve_view_graph

TOLERANCE_BEFORE_POINTS = 1e-3
"""Least tolerance of the epipolar adjustment where bundle adjustment follows: of four sets of photographs and two
simulated ones the final errors differ by 0.6 % at most, whether it is this or 1e-5."""
MATCHES_BEFORE_POINTS, TRACKS_BEFORE_POINTS = 60, 20
"""Maximum numbers of matches of a pair and of tracks of a triplet in jobs, where bundle adjustment decides the final
poses: with more, the errors of four sets of photographs and two simulated ones change by 3 % at most; most grow.
Ten tracks of a triplet do not suffice: the length of a street is then lost."""
AGREEING_WITH_LENSES = 0.9
"""Relative poses are estimated again if a solution found distortion and a smaller share of the inlier matches than this
lies in pairs that agree with it."""


def read_job_graph(
    database_path: str | PathLike[str],
    options: MappingOptions,
    log: StageLog,
    given: "pycolmap.Reconstruction | None" = None,
    lenses: FoundLenses | None = None,
) -> ViewGraph:
    """Read the viewing graph as a stage, with the measured positions that the options want.

    Parameters
    ----------
    database_path : path
    options : MappingOptions
    log : StageLog
    given : pycolmap.Reconstruction, optional
        Model to start from; the database must have all its images.
    lenses : FoundLenses, optional
        Of a first solution.
    """
    with log.stage("view graph"):
        graph, caveats = read_with_caveats(database_path, read_options(options), given, lenses)
        if given is not None:
            check_image_names(given, graph.image_names)
        for caveat in caveats:
            log.warn(caveat)
        graph = replace(graph, priors=_wanted_priors(graph.priors, options))
        log.result(f"{graph.num_images} images, {graph.num_edges} pairs, {int(graph.has_rotation.sum())} usable")
    return graph


def read_options(options: MappingOptions) -> ReadOptions:
    """Options of reading; what bundle adjustment must not refine is not changed, what it refines may be rough."""
    matches = min(options.read.max_matches_per_pose, MATCHES_BEFORE_POINTS)
    read = replace(options.read, random_seed=options.random_seed, max_matches_per_pose=matches)
    if not options.ba_refine_focal_length:
        read = replace(read, trust_focal_lengths="always")
    if not options.ba_refine_extra_params:
        read = replace(read, find_distortion=False)
    return read


def _wanted_priors(priors: PosePriors | None, options: MappingOptions) -> PosePriors | None:
    if priors is None:
        return None
    if not options.use_prior_position:
        return priors.without_positions()
    if options.overwrite_priors_covariance:
        return priors.with_sigmas(
            (options.prior_position_std_x, options.prior_position_std_y, options.prior_position_std_z)
        )
    return priors


def lenses_to_read_with(graph: ViewGraph, solution: PoseSolution, options: MappingOptions) -> FoundLenses | None:
    """Lenses to estimate pairs with again, where a solution found distortion and few of them agree; otherwise None."""
    terms, focal_lengths = solution.radial_terms, graph.camera_focal_lengths
    if terms is None or focal_lengths is None or not np.any(terms) or not solution.agreement:
        return None
    if not options.ba_refine_extra_params or graph.camera_idx is None:
        return None
    if solution.agreement[0].inliers >= AGREEING_WITH_LENSES and not solution.arrangements:
        return None
    before = np.zeros(len(terms)) if graph.found_radial_terms is None else graph.found_radial_terms
    anew = np.zeros(graph.num_edges) if graph.verified_anew is None else graph.verified_anew.astype(np.float64)
    cameras = graph.camera_idx[graph.edges].T.ravel()
    verified, every = (np.bincount(cameras, w, len(terms)) for w in (np.tile(anew, 2), np.ones(len(cameras))))
    return FoundLenses(focal_lengths * solution.focal_scales, terms, before, np.asarray(verified > 0.5 * every))


def solve_job_graph(graph: ViewGraph, options: MappingOptions, log: StageLog) -> PoseSolution:
    """Solve the viewing graph as a stage."""
    with log.stage("solve"):
        solution = solve_view_graph(graph, solve_options(options))
        for caveat in solution.caveats:
            log.warn(caveat)
        log.result(solution.message)
    return solution


def solve_options(options: MappingOptions) -> SolveOptions:
    """Options of solving for bundle adjustment: what that must not refine is fixed, what it refines may be rough."""
    given = options.solve
    solve = replace(
        given,
        random_seed=options.random_seed,
        adjustment_tolerance=max(given.adjustment_tolerance, TOLERANCE_BEFORE_POINTS),
        max_matches_per_edge=min(given.max_matches_per_edge or MATCHES_BEFORE_POINTS, MATCHES_BEFORE_POINTS),
        max_tracks_per_triplet=min(given.max_tracks_per_triplet or TRACKS_BEFORE_POINTS, TRACKS_BEFORE_POINTS),
    )
    return solve if options.ba_refine_focal_length else replace(solve, refine_focal_lengths="never")
