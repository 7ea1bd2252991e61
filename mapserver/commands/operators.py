"""`mapserver operators`: accounts of operators and programs."""

from typing import Annotated

import typer

from fleetmap.cli_options import Group, expand_options
from fleetmap.errors import UsageError
from mapserver.commands.options import ActorOptions, Json, StoreFolder, open_store, print_json, print_table
from mapserver.operators.roles import Role, Scope

Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the operator.")]
NewRole = Annotated[Role, typer.Option(help="viewer: reads; operator: changes versions too; admin: everything.")]
Asked = Annotated[bool, typer.Option("--ask", help="Ask for a password instead of making one.")]


@expand_options
def add(name: Name, store: StoreFolder, by: ActorOptions, role: NewRole = Role.VIEWER, ask: Asked = False) -> None:
    """Add an operator; prints the password once. With the first operator, the server requires sign-in."""
    from mapserver.operators.operators import Operators

    with open_store(store) as maps:
        chosen = _chosen(ask=ask)
        made = Operators(maps).add(name, role.value, chosen, by.named())
    typer.echo(f"operator {name} is a {role.value}{_shown(chosen, made)}")


@expand_options
def password(name: Name, store: StoreFolder, by: ActorOptions, ask: Asked = False) -> None:
    """Set a new password for an operator, also a disabled one; ends the existing sessions."""
    from mapserver.operators.operators import Operators

    with open_store(store) as maps:
        chosen = _chosen(ask=ask)
        made = Operators(maps).set_password(name, chosen, by.named())
    typer.echo(f"operator {name} has another password{_shown(chosen, made)}")


@expand_options
def role(
    name: Name,
    role: Annotated[Role, typer.Argument(metavar="ROLE", help="viewer, operator or admin.")],
    store: StoreFolder,
    by: ActorOptions,
) -> None:
    """Change the role of an operator, effective at once."""
    from mapserver.operators.operators import Operators

    with open_store(store) as maps:
        Operators(maps).set_role(name, role.value, by.named())
    typer.echo(f"operator {name} is a {role.value}")


@expand_options
def disable(name: Name, store: StoreFolder, by: ActorOptions) -> None:
    """End the sessions and tokens of a name at once, and refuse its sign-in."""
    with open_store(store) as maps:
        maps.operators.disable(name, by.named())
    typer.echo(f"operator {name} is disabled")


@expand_options
def token(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of an operator, or of a program.")],
    store: StoreFolder,
    by: ActorOptions,
    scope: Annotated[list[str] | None, typer.Option(metavar="SCOPE", help="What it may; repeat it.")] = None,
    days: Annotated[float, typer.Option(min=0.01, max=400, help="Days after which it ends.")] = 90,
) -> None:
    """Create a token for a program, sent as `Authorization: Bearer TOKEN`; prints it once."""
    from mapserver.operators.operators import Operators

    wrong = [word for word in scope or () if word not in set(Scope)]
    if wrong or not scope:
        raise UsageError(f"--scope {wrong[0] if wrong else ''}: choose the token's scope: {', '.join(Scope)}")
    with open_store(store) as maps:
        made = Operators(maps).make_token(name, scope, days, by.named())
    typer.echo(made)


def list_(store: StoreFolder, json: Json = False) -> None:
    """List operators and programs with their roles, sessions and tokens."""
    from mapserver.operators.operators import Operators

    with open_store(store, read_only=True) as maps:
        found = Operators(maps).all()
    if json:
        shown = ("name", "role", "is_disabled", "sessions", "tokens")
        print_json([{name: getattr(row, name) for name in shown} for row in found])
        return
    rows = ((r.name, r.role, r.sessions, r.tokens, "disabled" if r.is_disabled else "") for r in found)
    print_table(("name", "role", "sessions", "tokens", ""), rows)


def _chosen(*, ask: bool) -> str | None:
    """Ask for a password; None to have one generated."""
    return typer.prompt("password", hide_input=True, confirmation_prompt=True) if ask else None


def _shown(chosen: str | None, made: str) -> str:
    return f"; password (shown once): {made}" if chosen is None else ""


OPERATORS = Group(
    "Accounts of operators and programs.",
    {"add": add, "password": password, "role": role, "disable": disable, "token": token, "list": list_},
)
