"""The version of the installed distribution."""

from importlib import metadata  # takes a tenth of a second

try:
    __version__ = metadata.version("fleetmap")
except metadata.PackageNotFoundError:
    __version__ = "0+source"  # a source tree that is not installed
