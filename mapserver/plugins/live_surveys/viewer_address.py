"""Where `mapserver live` answers viewers."""

from ipaddress import ip_address
from typing import NamedTuple

from fleetmap.errors import UsageError

LOOPBACK = "127.0.0.1"


class ViewerAddress(NamedTuple):
    """Address for viewers; port 0 picks a free one."""

    host: str
    port: int


def viewer_address(text: str, *, insecure: bool) -> ViewerAddress:
    """Parse the value of `--foxglove`: PORT on loopback, or HOST:PORT.

    Raises UsageError for an invalid address, and for one that other machines can reach unless allowed: viewers do not sign in.
    """
    host, _, port = text.rpartition(":")
    host = host.strip("[]") or LOOPBACK
    if not (port.isascii() and port.isdecimal()) or int(port) > 65535:
        raise UsageError(f"--foxglove {text!r}: write it like 8765 or {LOOPBACK}:8765")
    try:
        is_local = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        is_local = False
    if not (is_local or insecure):
        raise UsageError(
            f"--foxglove {text}: viewers do not sign in, and other machines could see everything; leave {host} out and come "
            "through ssh -L, or pass --insecure on a network that only you can reach"
        )
    return ViewerAddress(host, int(port))
