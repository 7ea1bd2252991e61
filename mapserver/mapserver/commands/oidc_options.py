"""Options of `serve` for sign-in at an OpenID Connect provider."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapserver.operators.openid import Provider
    from mapserver.operators.roles import Role


@dataclass(frozen=True, kw_only=True)
class OidcOptions:
    """Which provider, and what it decides."""

    oidc_issuer: Annotated[
        str | None, typer.Option(metavar="URL", help="OpenID Connect provider at which people may sign in, too.")
    ] = None
    oidc_client: Annotated[str | None, typer.Option(metavar="ID", help="This server's client id there.")] = None
    oidc_secret: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The client's secret; default: fleetmap-oidc in $CREDENTIALS_DIRECTORY."),
    ] = None
    oidc_group: Annotated[
        list[str] | None, typer.Option(metavar="GROUP=ROLE", help="Role of a group there; repeat it.")
    ] = None
    oidc_groups_claim: Annotated[str, typer.Option(metavar="CLAIM", help="Claim that names the groups.")] = "groups"
    oidc_name_claim: Annotated[
        str, typer.Option(metavar="CLAIM", help="Claim that names people in the log; one that they cannot change.")
    ] = "sub"
    oidc_scope: Annotated[str, typer.Option(metavar="SCOPES", help="What is asked for.")] = "openid profile email"

    def load_provider(self) -> "Provider | None":
        """The provider; None without one. UsageError for options that cannot be right, or where the extra is not installed."""
        from fleetmap.errors import UsageError
        from mapserver.operators.openid import Provider, ProviderSettings

        if self.oidc_issuer is None:
            if self.oidc_client or self.oidc_secret or self.oidc_group:
                raise UsageError(
                    "--oidc-client, --oidc-secret and --oidc-group belong to --oidc-issuer; name the provider by it"
                )
            return None
        if not self.oidc_client:
            raise UsageError("--oidc-issuer needs --oidc-client, the id that the provider gave this server")
        if "openid" not in self.oidc_scope.split():
            raise UsageError(
                f"--oidc-scope {self.oidc_scope!r}: begin with openid; without it the provider names nobody"
            )
        return Provider(
            ProviderSettings(
                issuer=self.oidc_issuer,
                client_id=self.oidc_client,
                client_secret=self._secret(),
                roles=self._roles(),
                groups_claim=self.oidc_groups_claim,
                name_claim=self.oidc_name_claim,
                scope=self.oidc_scope,
            )
        )

    def _secret(self) -> str:
        from fleetmap.errors import UsageError, disk_errors
        from mapserver.trust.keys import credential

        if self.oidc_secret is None:
            found = credential("oidc")
        else:
            with disk_errors(
                f"--oidc-secret {self.oidc_secret} cannot be read", "check the path and its rights", UsageError
            ):
                found = self.oidc_secret.read_text("utf-8", "replace").strip()
        if not found:
            raise UsageError(
                "--oidc-issuer needs the client's secret: --oidc-secret FILE, or fleetmap-oidc in $CREDENTIALS_DIRECTORY"
            )
        return found

    def _roles(self) -> "dict[str, Role]":
        from fleetmap.errors import UsageError
        from mapserver.operators.roles import Role

        found = {}
        for given in self.oidc_group or ():
            group, _, role = given.rpartition("=")
            if not group or role not in set(Role):
                raise UsageError(
                    f"--oidc-group {given!r}: write it like map-people=operator, with one of {', '.join(Role)}"
                )
            if group in found:
                raise UsageError(f"--oidc-group names {group!r} twice; give it one role")
            found[group] = Role(role)
        if not found:
            raise UsageError("--oidc-issuer needs --oidc-group GROUP=ROLE: without a role nobody may sign in")
        return found
