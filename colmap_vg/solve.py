"""From a viewing graph to poses: the chain of rotation averaging, outlier filters, positions and refinement.

Nasiri, Hosseini, Moradi, "Solving Viewing Graph Optimization for Simultaneous Position and Rotation Registration",
Alg. 1 and 2, between a robust front (rotation gate, direction filter, rigidity) and, by default, the epipolar
adjustment behind them. Each step works on the part of the graph that is still solvable; whatever leaves gets a verdict.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from colmap_vg.edge_residuals import edge_residual_sigmas, rotation_residuals
from colmap_vg.edge_weights import edge_likelihoods, edge_weights
from colmap_vg.epipolar.adjustment import AdjustmentResult, adjust_epipolar, edge_errors
from colmap_vg.epipolar.baseline_lengths import connects_all, length_links, positions_by_lengths, solve_lengths
from colmap_vg.epipolar.covariance import camera_covariances
from colmap_vg.epipolar.problem import EpipolarProblem, epipolar_problem, focal_groups
from colmap_vg.epipolar.radial_term import fit_radial_term
from colmap_vg.errors import GraphError
from colmap_vg.graph.one_dsfm import one_dsfm_broken_weights
from colmap_vg.graph.subgraph import Subgraph
from colmap_vg.joint.alternation import solve_joint
from colmap_vg.ledger import Ledger, num_cameras
from colmap_vg.linear.threads import single_threaded_blas
from colmap_vg.options import SolveOptions
from colmap_vg.positions.bata import solve_bata
from colmap_vg.positions.cls import solve_cls
from colmap_vg.positions.cross import solve_cross
from colmap_vg.positions.direct import solve_cle1
from colmap_vg.positions.direction_filter import robust_direction_residuals
from colmap_vg.positions.fixed_point import solve_fixed_point
from colmap_vg.positions.lud import solve_lud
from colmap_vg.positions.orthogonal import solve_orthogonal
from colmap_vg.positions.robust_directions import position_deviations, solve_robust_directions
from colmap_vg.positions.shapefit import solve_shapefit
from colmap_vg.robust import geman_mcclure_weight
from colmap_vg.rotations.certificate import certify_chordal
from colmap_vg.rotations.chordal import average_rotations_chordal
from colmap_vg.rotations.consensus import ConsensusRotations, average_rotations_by_consensus
from colmap_vg.rotations.refinement import refine_rotations
from colmap_vg.solution import LogEntry, PoseSolution
from colmap_vg.verdicts import EdgeVerdict, ImageVerdict
from colmap_vg.view_graph import ViewGraph

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

MIN_COMPONENT_IMAGES = 3
"""Two images have no more than a direction between them."""
ROUGH_ITERATIONS = 20
"""Outer iterations of Alg. 2 before the epipolar adjustment, at most."""
MAX_DEVIATION = 0.1
"""Of a position, shares of the scene's median radius, where directions alone fix it: five times it is half of that."""
MAX_SHARE_LEAVING, MAX_ROUNDS_OF_LEAVING = 0.1, 20
"""Images that leave at once, and how often: one that is far off takes its neighbours' certainty with it, so that of
those that leave together none is three times as certain as another."""
CONTRADICTION = 10.0
"""Residuals of a pair over those of the median pair, in standard deviations, from which on it is false. What all pairs
share, a lens not quite as modelled, is in the median; noise of one pair does not reach five."""
MISFIT, MISFIT_PX = 3.0, 1.0
"""Median error of a pair's matches at the adjusted cameras from which on they do not fit: over that of the median pair,
and pixels."""
TRUST_PER_MEDIAN, TRUST_SCALES_DEG = 20.0, (3.0, 10.0)
"""Geman-McClure scale of what a rotation's residual says of the direction, over the median residual, and its range. A
false pair across a long street would otherwise fold it: it costs more displacement than tearing a street apart."""
CLEAR_LEAD = 1.0 / 3.0
"""Over any other solution of the rotations, as a share of the matches that agree with one of the two alone: the other
has less than half as many of them. On 400 graphs of objects that repeat themselves folded solutions led by 0.33 at
most, nearly all by less than 0.1, and 19 in 20 of those that were right by more than this."""
TRIAL_SHARE = 0.25
"""Share of the rotation gate that pairs on trial must keep within: one false pair in 10^5 does, by chance."""

_BASELINES = {
    "bata": solve_bata,
    "cle1": solve_cle1,
    "cross": solve_cross,
    "lud": solve_lud,
    "orthogonal": solve_orthogonal,
    "shapefit": solve_shapefit,
}


@single_threaded_blas
def solve_view_graph(
    graph: ViewGraph, options: SolveOptions | None = None, initial_rotations: ArrayLike | None = None
) -> PoseSolution:
    """Solve all rotations and positions of those parts, of three images or more, that directions and tracks fix.

    Parameters
    ----------
    graph : ViewGraph
    options : SolveOptions, optional
    initial_rotations : (n, 3, 3) array, optional
        cam_from_world rotations that averaging refines in place of searching for them. Where they are not finite for
        all images of a part, that part is searched. Robust averaging only.

    Returns
    -------
    PoseSolution
        In the graph's order of images and edges, the largest part as component 0. An unsolvable graph gives a
        solution with no registered image, status ``unsolvable`` and the reason in its message.
    """
    options = SolveOptions.given(options)
    ledger = Ledger(graph)
    initial = _initial_rotations(graph, initial_rotations)
    unsolved = np.ones(graph.num_images, dtype=bool)
    while True:
        part = ledger.largest_component(unsolved, ImageVerdict.SMALLER_COMPONENT)
        if part.num_images < MIN_COMPONENT_IMAGES:
            ledger.leave_out(part, ImageVerdict.SMALLER_COMPONENT)
            return ledger.solution()
        rotations, gated = _average_rotations(ledger, part, options, initial[part.images])
        gated = _admit_trials(ledger, gated, rotations, options)
        rigid = _filter_directions(ledger, gated, rotations, options)
        if rigid.num_images < MIN_COMPONENT_IMAGES:
            ledger.leave_out(gated, ImageVerdict.NOT_RIGID)
            unsolved[gated.images] = False
            continue
        own = rotations[gated.rows_of(rigid.images)]
        poses = _Poses(own, np.zeros((rigid.num_images, 3)), np.ones(num_cameras(graph)))
        rigid, poses = _solve_part(ledger, rigid, poses, options)
        if rigid.num_images < MIN_COMPONENT_IMAGES:
            ledger.leave_out(gated, ImageVerdict.NOT_RIGID)
            unsolved[gated.images] = False
            continue
        ledger.place(
            rigid,
            poses.rotations,
            poses.centers,
            poses.focal_scales,
            poses.converged,
            poses.covariances,
            poses.radial_terms,
        )
        unsolved[rigid.images] = False


@dataclass(frozen=True, eq=False)
class _Poses:
    """Poses of a part: cam_from_world (k, 3, 3), centres (k, 3), focal factors of the graph's cameras (c,)."""

    rotations: Array
    centers: Array
    focal_scales: Array
    converged: bool = True
    covariances: tuple[Array, Array] | None = None
    radial_terms: Array | None = None


def _initial_rotations(graph: ViewGraph, given: ArrayLike | None) -> Array:
    """Given rotations as an array; NaN where none are."""
    shape = (graph.num_images, 3, 3)
    if given is None:
        return np.full(shape, np.nan)
    rotations = np.asarray(given, dtype=np.float64)
    if rotations.shape != shape:
        raise GraphError(f"solve_view_graph: initial_rotations have shape {rotations.shape}, expected {shape}")
    return rotations


def _average_rotations(ledger: Ledger, part: Subgraph, options: SolveOptions, initial: Array) -> tuple[Array, Subgraph]:
    """Rotations of the part's images, and the part that the rotation gate leaves; gated until no edge goes."""
    graph, start = ledger.graph, initial if np.isfinite(initial).all() else None
    while part.num_images >= 2:
        relative = graph.cam2_from_cam1_rotations[part.edge_rows]
        weights = edge_weights(graph, part.edge_rows, options)
        if options.rotation_averaging == "chordal":
            result = average_rotations_chordal(part.num_images, part.edges, relative, weights)
            rotations, log = result.cam_from_world_rotations, result.log
        elif start is None:
            found = average_rotations_by_consensus(
                part.num_images,
                part.edges,
                relative,
                edge_likelihoods(graph, part.edge_rows),
                weights,
                options.random_seed,
            )
            rotations, log = found.cam_from_world_rotations, found.log
            _doubt_rival(ledger, part, found)
        else:
            # They were given, or found: the gate has only taken away what disagrees.
            likelihoods = edge_likelihoods(graph, part.edge_rows)
            rotations, log = refine_rotations(part.num_images, part.edges, relative, likelihoods, weights, start)
        bad = rotation_residuals(part.edges, relative, rotations) > np.radians(options.rotation_gate_deg)
        bad &= ~ledger.trusted[part.edge_rows]
        if options.rotation_gate_deg == 0.0 or not bad.any():
            ledger.log.extend(log)
            if options.certify_rotations:
                _certify_rotations(ledger, part, relative, rotations, weights, options)
            return rotations, part
        ledger.drop(part.edge_rows[bad], EdgeVerdict.ROTATION_OUTLIER)
        images = np.zeros(graph.num_images, dtype=bool)
        images[part.images] = True
        smaller = ledger.largest_component(images, ImageVerdict.CUT_OFF)
        part, start = smaller, rotations[part.rows_of(smaller.images)]
    return np.zeros((part.num_images, 3, 3)), part


def _doubt_rival(ledger: Ledger, part: Subgraph, found: ConsensusRotations) -> None:
    """Note other solutions of the rotations, and say where one agrees with nearly as many matches."""
    if found.rivals:
        ledger.note_arrangements(part, (found.cam_from_world_rotations, *found.rivals))
    if found.lead >= CLEAR_LEAD:
        return
    images = part.images[found.rival_images]
    names = ledger.graph.image_names or tuple(map(str, ledger.graph.image_ids.tolist()))
    shown = ", ".join(names[i] for i in images[:5]) + (", ..." if len(images) > 5 else "")
    ledger.doubt(
        images,
        "Another arrangement of the images agrees with nearly as many matches: the scene may repeat itself, and the"
        f" model may be folded. It places {len(images)} of {part.num_images} images otherwise ({shown}).",
    )


def _certify_rotations(
    ledger: Ledger, part: Subgraph, relative: Array, rotations: Array, weights: Array, options: SolveOptions
) -> None:
    """Log the smallest eigenvalue of the dual certificate, and say in a caveat what it tells."""
    if options.rotation_averaging != "chordal":
        ledger.caveats.append("The rotations are not certified: certificates are for rotation_averaging='chordal'.")
        return
    found = certify_chordal(part.num_images, part.edges, relative, rotations, weights)
    ledger.log.append(LogEntry("certificate", 0, found.lower_bound, found.smallest_eigenvalue))
    told = "are the global optimum" if found.is_global else "may not be the global optimum"
    ledger.caveats.append(
        f"The chordal rotations of {part.num_images} images {told}: the certificate's smallest eigenvalue is "
        f"{found.smallest_eigenvalue:.3g}, and no rotations cost less than {1.0 - found.relative_gap:.6f} of theirs."
    )


def _admit_trials(ledger: Ledger, part: Subgraph, rotations: Array, options: SolveOptions) -> Subgraph:
    """The part with those uncalibrated pairs besides whose rotations the averaged ones confirm."""
    if options.rotation_gate_deg == 0.0:
        return part
    graph, inside = ledger.graph, np.zeros(ledger.graph.num_images, dtype=bool)
    inside[part.images] = True
    trials = Subgraph.of(graph.edges, inside, ledger.edge_verdicts == EdgeVerdict.UNCALIBRATED)
    residuals = rotation_residuals(trials.edges, graph.cam2_from_cam1_rotations[trials.edge_rows], rotations)
    ledger.restore(trials.edge_rows[residuals <= np.radians(options.rotation_gate_deg * TRIAL_SHARE)])
    return Subgraph.of(graph.edges, inside, ledger.usable)


def _filter_directions(ledger: Ledger, part: Subgraph, rotations: Array, options: SolveOptions) -> Subgraph:
    """The largest part that its pairs fix, after edges whose directions contradict the rest have gone."""
    rigid = _fixed_part(ledger, part, options)
    if rigid.num_images < 3 or options.outlier_filter == "none":
        return rigid
    own = rotations[part.rows_of(rigid.images)]
    directions = _world_directions(ledger.graph, rigid, own)
    if options.outlier_filter == "1dsfm":
        broken = one_dsfm_broken_weights(
            rigid.num_images, rigid.edges, directions, options.one_dsfm_num_directions, options.random_seed
        )
        ledger.drop(rigid.edge_rows[broken > options.one_dsfm_threshold], EdgeVerdict.ONE_DSFM)
    elif options.direction_gate_deg > 0:
        weights = edge_weights(ledger.graph, rigid.edge_rows, options) * _rotation_trust(ledger.graph, rigid, own)
        _, angles = robust_direction_residuals(rigid.num_images, rigid.edges, directions, weights)
        ledger.drop(rigid.edge_rows[angles > np.radians(options.direction_gate_deg)], EdgeVerdict.DIRECTION_OUTLIER)
    return _fixed_part(ledger, rigid, options)


def _fixed_part(ledger: Ledger, part: Subgraph, options: SolveOptions) -> Subgraph:
    """The largest part that directions fix or, where these leave images out, directions and tracks of three views."""
    fixed = ledger.largest_rigid_part(part, options.random_seed)
    if fixed.num_images == part.num_images or options.method != "epipolar":
        return fixed
    graph = ledger.graph
    kept = part.with_edges(ledger.usable[part.edge_rows])
    problem = epipolar_problem(graph, kept, options)
    if problem is None:
        return fixed
    rows = kept.edge_rows
    links = length_links(problem, graph.cam2_from_cam1_rotations[rows], graph.cam2_in_cam1_directions[rows])
    ledger.note_ratios(rows[links.edges[links.firm]])
    return ledger.largest_rigid_part(part, options.random_seed)


def _rotation_trust(graph: ViewGraph, part: Subgraph, rotations: Array) -> Array:
    """Weights (e,) of directions by how well their edges' rotations agree: a pair that is wrong is so in both."""
    residuals = rotation_residuals(part.edges, graph.cam2_from_cam1_rotations[part.edge_rows], rotations)
    scale = np.clip(TRUST_PER_MEDIAN * np.median(residuals), *np.radians(TRUST_SCALES_DEG))
    return geman_mcclure_weight((residuals / scale) ** 2)


def _solve_part(ledger: Ledger, part: Subgraph, poses: _Poses, options: SolveOptions) -> tuple[Subgraph, _Poses]:
    """Poses by the method chosen, of the images that it can place."""
    if options.method != "epipolar":
        return part, _solve_poses(ledger, part, poses, options)
    problem = epipolar_problem(ledger.graph, part, options)
    if problem is None:
        return _solve_directions(ledger, part, poses, options)
    return _adjust_epipolar(ledger, part, problem, _rough_poses(ledger, part, problem, poses, options), options)


def _rough_poses(
    ledger: Ledger, part: Subgraph, problem: EpipolarProblem, poses: _Poses, options: SolveOptions
) -> _Poses:
    """Positions by the lengths that shared tracks give to baselines; by Alg. 2O where these do not reach all images."""
    graph, rows, n = ledger.graph, part.edge_rows, part.num_images
    links = length_links(problem, graph.cam2_from_cam1_rotations[rows], graph.cam2_in_cam1_directions[rows])
    lengths = solve_lengths(len(rows), links)
    start = None
    if not connects_all(n, part.edges, np.isfinite(lengths)):
        # The adjustment goes on from wherever Alg. 2 is: its last digits would be lost work.
        rough = replace(options, method="2O", max_num_iterations=ROUGH_ITERATIONS, convergence_tolerance=1e-3)
        poses = _solve_poses(ledger, part, poses, rough)
        start = poses.centers
    directions = _world_directions(graph, part, poses.rotations)
    return replace(poses, centers=positions_by_lengths(n, part.edges, directions, lengths, start))


def _solve_directions(ledger: Ledger, part: Subgraph, poses: _Poses, options: SolveOptions) -> tuple[Subgraph, _Poses]:
    """Positions by a robust fit of the directions; images that these do not fix well leave, the worst first."""
    whole, start = part, None
    for rounds_left in reversed(range(MAX_ROUNDS_OF_LEAVING + 1)):
        n, rotations = part.num_images, poses.rotations[whole.rows_of(part.images)]
        directions = _world_directions(ledger.graph, part, rotations)
        weights = edge_weights(ledger.graph, part.edge_rows, options)
        if start is None:
            start = solve_cls(n, part.edges, directions, weights).projection_centers
            start = solve_fixed_point(n, part.edges, directions, start, "C", weights, tolerance=1e-3).projection_centers
        solved = solve_robust_directions(n, part.edges, directions, start, weights)
        ledger.log.extend(solved.positions.log)
        centers = solved.positions.projection_centers
        deviations = position_deviations(n, part.edges, solved, options.random_seed)
        radius = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
        uncertain = deviations > MAX_DEVIATION * radius
        if not uncertain.any() or rounds_left == 0:
            break
        worst = max(np.quantile(deviations, 1.0 - MAX_SHARE_LEAVING), deviations.max() / 3.0)
        leaving = uncertain & (deviations >= worst)
        smaller = ledger.without(part, leaving, ImageVerdict.UNCERTAIN, options.random_seed)
        if smaller.num_images < MIN_COMPONENT_IMAGES:
            break
        part, start = smaller, centers[part.rows_of(smaller.images)]
    if uncertain.any():
        ledger.caveats.append(
            f"{int(uncertain.sum())} of {n} positions are uncertain: {ImageVerdict.UNCERTAIN.reason}."
        )
    return part, _Poses(rotations, centers, poses.focal_scales, solved.positions.converged)


def _solve_poses(ledger: Ledger, part: Subgraph, poses: _Poses, options: SolveOptions) -> _Poses:
    """Positions, or positions and rotations, by an algorithm on relative poses."""
    graph, method, n = ledger.graph, options.method, part.num_images
    directions = _world_directions(graph, part, poses.rotations)
    weights = edge_weights(graph, part.edge_rows, options)
    if method in _BASELINES:
        baseline = _BASELINES[method](n, part.edges, directions, weights)
        ledger.log.extend(baseline.log)
        return replace(poses, centers=baseline.projection_centers, converged=baseline.converged)
    start = solve_cls(n, part.edges, directions, weights)
    ledger.log.extend(start.log)
    if method == "cls":
        return replace(poses, centers=start.projection_centers, converged=start.converged)
    if method in ("1C", "1O"):
        fixed = solve_fixed_point(
            n,
            part.edges,
            directions,
            start.projection_centers,
            "C" if method == "1C" else "O",
            weights,
            accelerate=options.accelerate,
            max_num_iterations=options.max_num_iterations,
            tolerance=options.convergence_tolerance,
        )
        ledger.log.extend(fixed.log)
        return replace(poses, centers=fixed.projection_centers, converged=fixed.converged)
    information = None
    if method == "2W":
        if graph.edge_information is None:
            raise GraphError(
                "method 2W weighs edges by their information, and the graph holds none: read it from a database, set"
                " ViewGraph.edge_information, or solve with method 2C or 2O"
            )
        information = graph.edge_information[part.edge_rows]
        information = information / np.median(information[:, 3, 3])
    joint = solve_joint(
        n,
        part.edges,
        graph.cam2_from_cam1_rotations[part.edge_rows],
        graph.cam2_in_cam1_directions[part.edge_rows],
        poses.rotations,
        start.projection_centers,
        "C" if method == "2C" else "O",
        None if method == "2W" else weights,
        information=information,
        robust=method == "2W",
        accelerate=options.accelerate,
        max_num_iterations=options.max_num_iterations,
        tolerance=options.convergence_tolerance,
    )
    ledger.log.extend(joint.log)
    return replace(
        poses,
        rotations=joint.cam_from_world_rotations,
        centers=joint.projection_centers,
        converged=joint.converged,
    )


def _adjust_epipolar(
    ledger: Ledger, part: Subgraph, problem: EpipolarProblem, poses: _Poses, options: SolveOptions
) -> tuple[Subgraph, _Poses]:
    """Poses and free focal lengths at the minimum of the epipolar errors.

    Reversed edges leave, and with them images that the rest does not fix: those stood on the wrong side of an edge.
    """
    directions = ledger.graph.cam2_in_cam1_directions[part.edge_rows]
    found = adjust_epipolar(problem, poses.rotations, poses.centers, directions)
    ledger.log.extend(found.log)
    problem, found, radial_terms = _with_radial_term(ledger, problem, found, directions)
    ledger.drop(part.edge_rows[found.reversed_edges], EdgeVerdict.REVERSED)
    # Relative poses of bent rays contradict straight ones, right as both may be.
    dropped = found.reversed_edges | (_contradicting(ledger, part, problem, found) & (radial_terms is None))
    if dropped.sum() > found.reversed_edges.sum():
        ledger.drop(part.edge_rows[dropped & ~found.reversed_edges], EdgeVerdict.CONTRADICTS_POSES)
        rest = problem.without(dropped)
        kept = part.with_edges(~dropped)
        if ledger.largest_rigid_part(kept, options.random_seed).num_images < part.num_images:
            # Tracks that were not needed before may hold what is left.
            rest = epipolar_problem(ledger.graph, kept, options) or rest
        rest = replace(rest, free_focals=problem.free_focals & ~found.lost_focals)
        again = adjust_epipolar(
            rest,
            found.cam_from_world_rotations,
            found.projection_centers,
            directions[~dropped],
            initial_focal_scales=found.focal_scales,
            scales_px=(found.scale_px,),
            final_sigmas=0.0,
        )
        ledger.log.extend(again.log)
        ledger.drop(part.edge_rows[~dropped][again.reversed_edges], EdgeVerdict.REVERSED)
        problem, lost = rest, found.lost_focals | again.lost_focals
        found = replace(again, lost_focals=lost)
    group = focal_groups(ledger.graph)[0]
    if found.lost_focals.any():
        count = int(found.lost_focals[group].sum())
        ledger.caveats.append(
            f"The matches do not tell the focal length of {count} of {len(group)} cameras; it stays as it was read."
        )
    fixed = _fixed_part(ledger, part, options) if dropped.any() else part
    rows = part.rows_of(fixed.images)
    solved = _Poses(
        found.cam_from_world_rotations[rows],
        found.projection_centers[rows],
        found.focal_scales[group],
        found.converged,
        radial_terms=radial_terms,
    )
    if options.covariances:
        known = camera_covariances(problem, found, seed=options.random_seed)
        solved = replace(solved, covariances=(known.positions[rows], known.rotations[rows]))
    return fixed, solved


def _with_radial_term(
    ledger: Ledger, problem: EpipolarProblem, found: AdjustmentResult, directions: Array
) -> tuple[EpipolarProblem, AdjustmentResult, Array | None]:
    """The problem, its cameras and the radial terms (c,) after one was found, where lenses are free and ask for it."""
    graph, (group, first) = ledger.graph, focal_groups(ledger.graph)
    free = problem.free_focals & ~found.lost_focals
    if graph.camera_radial is None or not free.any():
        return problem, found, None
    bendable = free & (np.bincount(group, weights=~graph.camera_radial, minlength=len(first)) == 0)
    lens = fit_radial_term(problem, found, bendable) if bendable.any() else None
    if lens is None:
        return problem, found, None
    start = lens.result
    again = adjust_epipolar(
        lens.problem,
        start.cam_from_world_rotations,
        start.projection_centers,
        directions,
        initial_focal_scales=start.focal_scales,
        scales_px=(start.scale_px,),
    )
    ledger.log.extend(again.log)
    terms = np.where(bendable, lens.radial_term * np.square(again.focal_scales), 0.0)[group]
    return lens.problem, again, np.asarray(terms)


def _contradicting(ledger: Ledger, part: Subgraph, problem: EpipolarProblem, found: AdjustmentResult) -> BoolArray:
    """Edges (e,) of a part whose relative poses and matches no noise takes that far from the adjusted cameras."""
    graph, rows = ledger.graph, part.edge_rows
    if graph.edge_information is None:
        return np.zeros(len(rows), dtype=bool)
    sigmas = edge_residual_sigmas(
        part.edges,
        graph.cam2_from_cam1_rotations[rows],
        graph.cam2_in_cam1_directions[rows],
        graph.edge_information[rows],
        found.cam_from_world_rotations,
        found.projection_centers,
    )
    contradicting = (sigmas > CONTRADICTION * max(float(np.median(sigmas)), 1.0)) & ~ledger.trusted[rows]
    if contradicting.any():
        # A pose by itself may be the worse of two that nearly explain a plane's matches.
        errors = edge_errors(problem, found)
        contradicting &= errors > max(MISFIT * float(np.median(errors)), MISFIT_PX)
    return np.asarray(contradicting)


def _world_directions(graph: ViewGraph, part: Subgraph, rotations: Array) -> Array:
    """``gamma_ij = R_i gamma^l_ij`` with R_i camera to world, (e, 3)."""
    local = graph.cam2_in_cam1_directions[part.edge_rows]
    return np.asarray(np.einsum("kba,kb->ka", rotations[part.edges[:, 0]], local))
