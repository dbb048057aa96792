"""Errors: what stops a run before it starts, what fails one image, what is a bug."""

from pipeline.status import StatusReason


class PilotageError(Exception):
    """Base of every error that Pilotage raises on purpose; its text is one line for the user."""


class ConfigurationError(PilotageError):
    """A configuration, archive description or command line that cannot be run; nothing has started yet."""


class ImageFailure(PilotageError):
    """One image cannot be navigated; the run goes on and the reason stands in that image's record.

    Parameters
    ----------
    reason
        The enumerated cause.
    detail
        One line for a person, with the figures that led to it.
    """

    def __init__(self, reason: StatusReason, detail: str) -> None:
        super().__init__(detail)
        self.reason = reason
        self.detail = detail

    def __reduce__(self) -> tuple[type["ImageFailure"], tuple[StatusReason, str]]:
        """Pickle by both arguments: the default would lose the reason on the way back from a worker."""
        return (type(self), (self.reason, self.detail))


class ImageError(ImageFailure):
    """The image file itself: missing, truncated, of the wrong format or shape."""


class GeometryError(ImageFailure):
    """The label, sidecar or camera of one image: absent, inconsistent or out of coverage."""


class CatalogError(ImageFailure):
    """A star table that this one image brought along cannot be used."""


class ContractError(PilotageError):
    """An invariant inside Pilotage is broken: a bug, never the data's fault."""
