"""The words in which verdicts on edges, images and whole solutions are given."""

from enum import StrEnum


class EdgeVerdict(StrEnum):
    """Why an edge (a verified image pair) was kept or left out."""

    KEPT = "kept"
    ROTATION_ONLY = "rotation_only"
    """Used for rotations; its direction says nothing (panoramic pair, vanishing baseline)."""
    NO_POSE = "no_pose"
    """No relative pose could be recovered from its inliers."""
    DEGENERATE = "degenerate"
    """COLMAP found no geometry that explains the matches."""
    WATERMARK = "watermark"
    """The matches move as an overlay does, not as a scene does."""
    FEW_INLIERS = "few_inliers"
    UNCALIBRATED = "uncalibrated"
    """Explained by a fundamental matrix only, although the focal lengths are known: mostly a false pair."""
    ROTATION_OUTLIER = "rotation_outlier"
    """Its rotation contradicts the averaged rotations."""
    DIRECTION_OUTLIER = "direction_outlier"
    """Its direction contradicts the solved positions."""
    ONE_DSFM = "one_dsfm"
    """1DSfM's broken weight is above the threshold."""
    REVERSED = "reversed"
    """Its direction points away from the solved one."""
    OUTSIDE = "outside_component"
    """It lies outside what was solved, or links two models."""


class ImageVerdict(StrEnum):
    """Why an image was registered or left out."""

    REGISTERED = "registered"
    """It is in the largest model."""
    OTHER_MODEL = "other_model"
    """It is in a smaller model of its own frame; nothing that holds links the two."""
    NO_EDGES = "no_edges"
    """No verified pair of this image could be used."""
    SMALLER_COMPONENT = "smaller_component"
    """It is connected only to images outside the largest component, too few for a model of their own."""
    CUT_OFF = "cut_off"
    """All edges that linked it to the solved images were outliers."""
    NOT_RIGID = "not_rigid"
    """Its edges do not fix its position relative to the others (for instance a single edge)."""
    FEW_OBSERVATIONS = "few_observations"
    """Too few triangulated points are seen in it."""


class SolutionStatus(StrEnum):
    """How a viewing-graph solve ended."""

    SOLVED = "solved"
    PARTIAL = "partial"
    """Solved, but some images are not in the largest model."""
    NOT_CONVERGED = "not_converged"
    """The iteration limit was reached; the poses are the best found."""
    UNSOLVABLE = "unsolvable"
    """Nothing could be solved: no usable edges, or no two connected images."""
