"""How an image ends: one status, one reason, one rank."""

from enum import StrEnum


class Status(StrEnum):
    """Outcome of one image."""

    SUCCESS = "success"
    FAILED = "failed"
    CONFLICTED = "conflicted"
    ERROR = "error"


class Rank(StrEnum):
    """Tier of trust in an answer, for people who filter tables."""

    HIGH = "high"
    MEDIUM = "medium"
    LOW = "low"
    FAILED = "failed"
    CONFLICTED = "conflicted"


class StatusReason(StrEnum):
    """The one cause behind a status; a table column, so values are never renamed lightly."""

    # success
    NAVIGATED = "navigated"
    NAVIGATED_ONE_DIRECTION = "navigated_one_direction"
    NAVIGATED_AT_EDGE = "navigated_at_edge"
    # failed: the image was read, no answer can be vouched for
    IMAGE_BLANK = "image_blank"
    IMAGE_OVEREXPOSED = "image_overexposed"
    IMAGE_MOSTLY_MISSING = "image_mostly_missing"
    IMAGE_NOT_FINITE = "image_not_finite"
    NO_FEATURES_PREDICTED = "no_features_predicted"
    NO_FEATURES_DETECTED = "no_features_detected"
    NO_MATCH = "no_match"
    AMBIGUOUS_MATCH = "ambiguous_match"
    LOW_CONFIDENCE = "low_confidence"
    # conflicted
    TECHNIQUES_DISAGREE = "techniques_disagree"
    # error: the image could not be worked on
    IMAGE_NOT_FOUND = "image_not_found"
    IMAGE_EMPTY = "image_empty"
    IMAGE_TRUNCATED = "image_truncated"
    IMAGE_FORMAT_UNKNOWN = "image_format_unknown"
    IMAGE_UNREADABLE = "image_unreadable"
    IMAGE_SHAPE_MISMATCH = "image_shape_mismatch"
    GEOMETRY_MISSING = "geometry_missing"
    GEOMETRY_INVALID = "geometry_invalid"
    CAMERA_UNKNOWN = "camera_unknown"
    KERNELS_UNAVAILABLE = "kernels_unavailable"
    CATALOG_INVALID = "catalog_invalid"
    WORKER_LOST = "worker_lost"
    INTERNAL_ERROR = "internal_error"


_STATUS_OF_REASON = {
    Status.SUCCESS: ("navigated", "navigated_one_direction", "navigated_at_edge"),
    Status.FAILED: (
        "image_blank", "image_overexposed", "image_mostly_missing", "image_not_finite", "no_features_predicted",
        "no_features_detected", "no_match", "ambiguous_match", "low_confidence",
    ),
    Status.CONFLICTED: ("techniques_disagree",),
}  # fmt: skip


def status_of(reason: StatusReason) -> Status:
    """Status that a reason belongs to.

    Parameters
    ----------
    reason
        Any member of the enumeration.

    Returns
    -------
    Status
        The one status under which the reason may appear.
    """
    for status, reasons in _STATUS_OF_REASON.items():
        if reason.value in reasons:
            return status
    return Status.ERROR
