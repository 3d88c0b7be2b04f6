"""Stage 1 of the solver: rotation averaging of a connected part, and removal of outlier pairs."""

import numpy as np
from numpy.typing import NDArray

from colmap_vg.options import SolveOptions
from colmap_vg.rotations.certificate import certify_chordal
from colmap_vg.rotations.chordal import average_rotations_chordal
from colmap_vg.rotations.consensus import ConsensusRotations, average_rotations_by_consensus
from colmap_vg.rotations.gravity import refine_by_gravity
from colmap_vg.rotations.refinement import refine_rotations
from colmap_vg.scene.edge_residuals import rotation_residuals
from colmap_vg.scene.solution import LogEntry
from colmap_vg.scene.subgraph import Subgraph
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict
from colmap_vg.solver.edge_weights import edge_likelihoods, edge_weights
from colmap_vg.solver.state import SolverState

Array = NDArray[np.float64]

CLEAR_LEAD = 1.0 / 3.0
"""Least lead over any other solution of the rotations that is not doubtful, as a share of the matches that agree with
exactly one of the two: the other then has less than half as many of them. On 400 graphs of objects that repeat
themselves, folded solutions led by at most 0.33, nearly all by less than 0.1; 19 in 20 correct ones led by more."""
TRIAL_SHARE = 0.25
"""Threshold for admitting uncalibrated pairs, as a share of the rotation gate; one false pair in 10^5 passes by
chance."""


def average_rotations(
    state: SolverState, part: Subgraph, options: SolveOptions, initial: Array
) -> tuple[Array, Subgraph]:
    """Average rotations and drop edges beyond the rotation gate until none is left; return rotations and the part."""
    graph, start = state.graph, initial if np.isfinite(initial).all() else None
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
            _doubt_rival(state, part, found)
        else:
            # Given rotations, or those of the last round, of which the gate has only removed disagreeing edges.
            likelihoods = edge_likelihoods(graph, part.edge_rows)
            rotations, log = refine_rotations(part.num_images, part.edges, relative, likelihoods, weights, start)
        bad = rotation_residuals(part.edges, relative, rotations) > np.radians(options.rotation_gate_deg)
        bad &= ~state.trusted[part.edge_rows]
        if options.rotation_gate_deg == 0.0 or not bad.any():
            state.log.extend(log)
            if options.certify_rotations:
                _certify_rotations(state, part, relative, rotations, weights, options)
            return _with_gravity(state, part, relative, rotations, weights, options), part
        state.drop(part.edge_rows[bad], EdgeVerdict.ROTATION_OUTLIER)
        images = np.zeros(graph.num_images, dtype=bool)
        images[part.images] = True
        smaller = state.largest_component(images, ImageVerdict.CUT_OFF)
        part, start = smaller, rotations[part.rows_of(smaller.images)]
    return np.zeros((part.num_images, 3, 3)), part


def admit_confirmed_pairs(state: SolverState, part: Subgraph, rotations: Array, options: SolveOptions) -> Subgraph:
    """Add the uncalibrated pairs whose rotations agree with the averaged ones; return the part with them."""
    if options.rotation_gate_deg == 0.0:
        return part
    graph, inside = state.graph, np.zeros(state.graph.num_images, dtype=bool)
    inside[part.images] = True
    trials = Subgraph.of(graph.edges, inside, state.edge_verdicts == EdgeVerdict.UNCALIBRATED)
    residuals = rotation_residuals(trials.edges, graph.cam2_from_cam1_rotations[trials.edge_rows], rotations)
    state.restore(trials.edge_rows[residuals <= np.radians(options.rotation_gate_deg * TRIAL_SHARE)])
    return Subgraph.of(graph.edges, inside, state.usable)


def _with_gravity(
    state: SolverState, part: Subgraph, relative: Array, rotations: Array, weights: Array, options: SolveOptions
) -> Array:
    """Refine averaged rotations by measured gravity, if there is any; say which directions are wrong."""
    priors = state.graph.priors
    if priors is None or not options.use_prior_gravity or not priors.has_gravity[part.images].any():
        return rotations
    gravities = priors.gravities[part.images]
    found = refine_by_gravity(part.num_images, part.edges, relative, weights, rotations, gravities, options.random_seed)
    measured = np.isfinite(gravities).all(axis=1)
    num, wrong = int(measured.sum()), int((measured & ~found.used).sum())
    if wrong:
        state.caveats.append(
            f"{wrong} of {num} measured directions of gravity contradict the rotations and are not used."
        )
    if found.flipped.any():
        state.caveats.append(f"{int(found.flipped.sum())} of {num} measured directions of gravity are upside down.")
    return found.rotations


def _doubt_rival(state: SolverState, part: Subgraph, found: ConsensusRotations) -> None:
    """Record alternative rotations, and mark images in doubt if one agrees with as many matches, or nearly."""
    if found.rivals:
        state.note_arrangements(part, (found.cam_from_world_rotations, *found.rivals))
    if found.lead >= CLEAR_LEAD:
        return
    images = part.images[found.rival_images]
    names = state.graph.image_names or tuple(map(str, state.graph.image_ids.tolist()))
    shown = ", ".join(names[i] for i in images[:5]) + (", ..." if len(images) > 5 else "")
    state.doubt(
        images,
        "Another arrangement of the images agrees with as many matches, or nearly: the scene may repeat itself, and the"
        f" model may be folded. The poses of {len(images)} of {part.num_images} images differ in it ({shown}).",
    )


def _certify_rotations(
    state: SolverState, part: Subgraph, relative: Array, rotations: Array, weights: Array, options: SolveOptions
) -> None:
    """Log the smallest eigenvalue of the dual certificate, and add its interpretation to the caveats."""
    if options.rotation_averaging != "chordal":
        state.caveats.append("The rotations are not certified: certificates need rotation_averaging='chordal'.")
        return
    found = certify_chordal(part.num_images, part.edges, relative, rotations, weights)
    state.log.append(LogEntry("certificate", 0, found.lower_bound, found.smallest_eigenvalue))
    verdict = "are the global optimum" if found.is_global else "may not be the global optimum"
    state.caveats.append(
        f"The chordal rotations of {part.num_images} images {verdict}: the certificate's smallest eigenvalue is "
        f"{found.smallest_eigenvalue:.3g}, and any rotations cost at least {1.0 - found.relative_gap:.6f} of theirs."
    )
