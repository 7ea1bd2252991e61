"""Operations on accounts: operators and programs, their roles, passwords and tokens.

A right is given by those who have it: a token that manages operators cannot make an admin of anybody.
"""

from functools import partial
from typing import Annotated

from typer import Argument, Option, prompt

from fleetmap.errors import StateError
from mapserver.api.operations.operation import Caller, Done, operation
from mapserver.operators.roles import OPERATOR_PATTERN, SCOPES, Role, Scope

Name = Annotated[
    str,
    Argument(metavar="NAME", help="Name of the operator, or of a program."),
    {"pattern": OPERATOR_PATTERN, "examples": ["bob"]},
]
NewRole = Annotated[Role, Option(help="viewer: reads; operator: changes versions too; admin: everything.")]
RoleArgument = Annotated[Role, Argument(metavar="ROLE", help="viewer, operator or admin.")]
Scopes = Annotated[
    list[Scope],
    Option("--scope", metavar="SCOPE", help="What it may; repeat it."),
    {"min_length": 1, "max_length": len(Scope)},
]
Days = Annotated[float, Option(min=0.01, max=400, help="Days after which it ends.")]
Number = Annotated[str, Argument(metavar="NUMBER", help="Number of the token.")]
Ask = Annotated[bool, Option("--ask", help="Ask for a password instead of making one.")]
of_people = partial(operation, needs=Scope.OPERATORS)


@of_people("/v1/operators", "operators add", answer="Secret")
def add_operator(caller: Caller, name: Name, role: NewRole = Role.VIEWER, *, ask: Ask = False) -> Done:
    """Add an operator; the password is shown once. With the first operator, the server requires sign-in."""
    if caller.is_anybody and role is not Role.ADMIN:
        raise StateError(f"{name} would be the first operator, and could add nobody; begin with an admin")
    caller.check_has(SCOPES[role])
    chosen = _chosen(ask=ask)
    made = caller.operators.add(name, role, chosen, caller.actor)
    return Done(f"operator {name} is a {role}{_shown(chosen, made)}", {"name": name, "secret": made})


@of_people("/v1/operators/{operator}/password", "operators password", answer="Secret")
def renew_password(caller: Caller, operator: Name, *, ask: Ask = False) -> Done:
    """Set a new password, shown once, for an operator, also a disabled one; ends the existing sessions."""
    row = caller.store.operators.find(operator)
    caller.check_has(() if row is None else SCOPES[row.role])
    chosen = _chosen(ask=ask)
    made = caller.operators.set_password(operator, chosen, caller.actor)
    return Done(f"operator {operator} has another password{_shown(chosen, made)}", {"name": operator, "secret": made})


@of_people("/v1/operators/{operator}/role", "operators role")
def change_role(caller: Caller, operator: Name, role: RoleArgument) -> Done:
    """Change the role of an operator, effective at once; sessions go on."""
    caller.check_has(SCOPES[role])
    caller.operators.set_role(operator, role, caller.actor, keeps_an_admin=caller.served is not None)
    return Done(f"operator {operator} is a {role}")


@of_people("/v1/operators/{operator}/disable", "operators disable")
def disable_operator(caller: Caller, operator: Name) -> Done:
    """End the sessions and tokens of an operator or program at once, and refuse its sign-in until it has a new password."""
    caller.store.operators.disable(operator, caller.actor, keeps_an_admin=caller.served is not None)
    return Done(f"operator {operator} is disabled")


@of_people("/v1/tokens", "operators token", answer="Secret")
def make_token(caller: Caller, name: Name, scopes: Scopes, days: Days = 90) -> Done:
    """Create a token, shown once, for an operator or a program, which sends it as `Authorization: Bearer TOKEN`."""
    if caller.is_anybody:
        raise StateError("with the first token everybody signs in, and nobody could; add an admin before it")
    caller.check_has(scopes)
    made = caller.operators.make_token(name, scopes, days, caller.actor)
    return Done(made, {"name": name, "secret": made})


@of_people("/v1/tokens/{token}/revoke", "operators revoke")
def revoke_token(caller: Caller, token: Number) -> Done:
    """End one token at once; the other tokens of its owner stay."""
    caller.store.operators.revoke_token(token, caller.actor)
    return Done(f"token {token} is revoked")


def _chosen(*, ask: bool) -> str | None:
    """Ask for a password; None to have one generated."""
    return prompt("password", hide_input=True, confirmation_prompt=True) if ask else None


def _shown(chosen: str | None, made: str) -> str:
    return f"; password (shown once): {made}" if chosen is None else ""
