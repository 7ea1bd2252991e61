"""Endpoints of the bus, as zenoh writes them: tcp/HOST:PORT."""

import socket
from ipaddress import ip_address

from fleetmap.errors import UsageError


def check_endpoint(endpoint: str) -> str:
    """`endpoint` itself; raises UsageError unless it reads like tcp/HOST:PORT (also tls, quic, udp)."""
    protocol, slash, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if not slash or protocol not in {"tcp", "tls", "quic", "udp"} or not host or not port.isdecimal():
        raise UsageError(f"endpoint {endpoint!r}: write it like tcp/127.0.0.1:7447")
    if int(port) > 65535:
        raise UsageError(f"endpoint {endpoint!r}: port {port} is above 65535")
    return endpoint


def has_tls(endpoint: str) -> bool:
    """Whether an endpoint's protocol has TLS in it."""
    return endpoint.startswith(("tls/", "quic/"))


def is_loopback(endpoint: str) -> bool:
    """Whether nobody but this machine is at an endpoint."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def with_free_port(endpoint: str) -> str:
    """`endpoint` with a port that is free at this moment in the place of 0."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    if port != "0":
        return endpoint
    family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.bind((host.strip("[]"), 0))
        return f"{protocol}/{host}:{probe.getsockname()[1]}"
