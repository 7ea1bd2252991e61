"""Foxglove: channels of maps, robots, fixes, images and failures, and MCAP files of them.

All modules here need the extra `foxglove`: call `require_foxglove` before they are imported.
"""

from fleetmap.errors import UsageError


def require_foxglove(what: str) -> None:
    """Raise UsageError if Foxglove's library is missing; what: the feature that needs it."""
    try:
        import foxglove  # noqa: F401
    except ImportError as error:
        raise UsageError(
            f"{what} needs {error.name}, which is not installed; pip install '.[foxglove]' in fleetmap's source folder"
        ) from error
