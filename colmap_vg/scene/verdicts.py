"""Verdicts on edges, images and whole solutions, each with its reason."""

from enum import StrEnum
from typing import Self


class Verdict(StrEnum):
    """A word with its meaning as the clause `reason`."""

    reason: str

    def __new__(cls, word: str, reason: str) -> Self:
        """Create a member that equals its word."""
        member = str.__new__(cls, word)
        member._value_ = word
        member.reason = reason
        return member

    @classmethod
    def reason_of(cls, word: str) -> str:
        """Reason of a word; a text that is no word of this kind is its own reason, as of a file that was skipped."""
        return {str(verdict): verdict.reason for verdict in cls}.get(word, word)


class EdgeVerdict(Verdict):
    """Whether an edge (a verified image pair) was used, or why not."""

    KEPT = "kept", "rotation and direction were used"
    ROTATION_ONLY = (
        "rotation_only",
        "used for rotations; its direction is undetermined (panoramic pair, vanishing baseline)",
    )
    NO_POSE = "no_pose", "no relative pose explains its matches"
    DEGENERATE = "degenerate", "COLMAP found no geometry that explains the matches"
    WATERMARK = "watermark", "the matches move as an overlay does, not as a scene does"
    FEW_INLIERS = "few_inliers", "fewer verified matches than `min_num_inliers`"
    EXCLUDED = "excluded", "on the user's list of pairs not to be used"
    UNCALIBRATED = (
        "uncalibrated",
        "explained by a fundamental matrix only, although the focal lengths are known, and confirmed by nothing else",
    )
    ROTATION_OUTLIER = "rotation_outlier", "its rotation contradicts the averaged rotations"
    DIRECTION_OUTLIER = "direction_outlier", "its direction contradicts the solved positions"
    ONE_DSFM = "one_dsfm", "1DSfM's broken weight is above the threshold"
    CONTRADICTS_POSES = (
        "contradicts_poses",
        "its relative pose is ten times as far from the solved one as that of other pairs, in standard deviations",
    )
    REVERSED = "reversed", "its direction points away from the solved one"
    OUTSIDE = "outside_component", "it is outside the solved part, or links two models"


USED_EDGES = (EdgeVerdict.KEPT, EdgeVerdict.ROTATION_ONLY)
"""Verdicts on edges that the solution uses."""


class ImageVerdict(Verdict):
    """Whether an image was registered, or why not."""

    REGISTERED = "registered", "it is in the largest model"
    OTHER_MODEL = "other_model", "it is in a smaller model with its own frame; no reliable pairs link the two"
    NO_EDGES = "no_edges", "no verified pair of this image could be used"
    SMALLER_COMPONENT = (
        "smaller_component",
        "it is connected only to images outside the largest component, too few for a model of their own",
    )
    CUT_OFF = "cut_off", "all edges that linked it to the solved images were outliers"
    NOT_RIGID = (
        "not_rigid",
        "neither the directions of its pairs nor tracks through three images fix its position relative to the others",
    )
    UNCERTAIN = "uncertain", "its pairs determine its position to worse than a tenth of the scene's radius"
    MISPLACED = "misplaced", "its pose from triangulated points contradicts the relative poses of its pairs"
    FEW_OBSERVATIONS = (
        "few_observations",
        "it observes too few triangulated points that three images see at a sufficient angle",
    )


class SolutionStatus(Verdict):
    """How a viewing-graph solve ended."""

    SOLVED = "solved", "every image has a pose in one frame"
    PARTIAL = "partial", "some images are not in the largest model"
    DOUBTFUL = (
        "doubtful",
        "the model may be folded, or may join two places that look alike: too many pairs contradict it, or another"
        " arrangement of its images agrees with as many matches, or nearly",
    )
    NOT_CONVERGED = "not_converged", "an iteration limit was reached; the poses are the best found"
    UNSOLVABLE = (
        "unsolvable",
        "nothing could be solved: there are no usable pairs, or no three images whose positions are determined",
    )
