"""Where HTTP may be served: on this machine to everybody, beyond it with TLS to operators alone. Pure."""

from dataclasses import dataclass
from ipaddress import ip_address


@dataclass(frozen=True, slots=True, kw_only=True)
class HttpBinding:
    """How a server is to be reached. address: of --http; host: its host; names: other names that it goes by, as a proxy passes them on."""

    address: str
    host: str
    names: tuple[str, ...] = ()
    has_tls: bool = False
    has_operators: bool = False


def binding_fault(binding: HttpBinding) -> str:
    """Why a server must not start like this, and what to do; empty where it may."""
    is_local = is_loopback_name(binding.host)
    steps = []
    if not is_local and not binding.has_tls:
        steps.append("give it a certificate with --http-cert and --http-key")
    beyond = [name for name in binding.names if not is_loopback_name(name)]
    if (not is_local or beyond) and not binding.has_operators:
        steps.append("name who may sign in with `mapserver operators add NAME --role admin`")
    if not steps:
        return ""
    where = f"--http {binding.address}" if not is_local else f"--http-name {beyond[0]}"
    return f"{where} is reached from other machines; {', and '.join(steps)} (or let everybody in with --insecure)"


def is_loopback_name(host: str) -> bool:
    """Whether a host's name or address is the machine itself."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False
