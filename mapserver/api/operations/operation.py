"""An operation: what people change, as one function that is a route, a command and an act of a page.

It takes who asks and typed parameters, has the log written by its rule, and says what it did. Parameters are annotated as typer's are; a
dictionary beside has what HTTP checks before the rule does, as pydantic's `Field` takes it. One in braces in the path is a part of the
address, the others are in the body; a keyword-only one is an option of the command alone. The docstring is the help of all doors:
`api/operation_routes.py`, `commands/operation_commands.py`, and `operate` in the templates of pages.
"""

from collections.abc import Callable, Iterable, Mapping
from inspect import Parameter, signature
from typing import TYPE_CHECKING, Any, NamedTuple

from fleetmap.errors import ForbiddenError
from mapserver.operators.roles import Identity, Scope

if TYPE_CHECKING:
    from mapserver.config import MapserverConfig
    from mapserver.operators.operators import Operators
    from mapserver.store import Actor, MapStore


class Done(NamedTuple):
    """What an operation did. words: for who typed its command; answer: over HTTP, None for `ok`."""

    words: str
    answer: Any = None


class Caller(NamedTuple):
    """Who asks, of an open store. served: `Served` of the server, None for a command; who: None for one, and while nobody signs in."""

    store: "MapStore"
    actor: "Actor"
    config: "MapserverConfig"
    served: Any = None
    who: Identity | None = None

    @property
    def is_anybody(self) -> bool:
        """True for a request to a server where nobody signs in."""
        return self.served is not None and self.who is None

    @property
    def operators(self) -> "Operators":
        from mapserver.operators.operators import Operators

        found: Operators = Operators(self.store) if self.served is None else self.served.operators
        return found

    def check_has(self, scopes: Iterable[str]) -> None:
        """Raise ForbiddenError for rights that the caller lacks; whoever has the store's folder has all."""
        if self.who is not None and (beyond := set(scopes) - self.who.scopes):
            words = f"{self.who.name} cannot give the right to {sorted(beyond)[0]!r} without having it"
            raise ForbiddenError(words)


class Operation(NamedTuple):
    """An operation and where it is found.

    path: of its POST route. command: its words, such as "operators add". needs: the right to it over HTTP. answer: its model in
    `api/views.py`. page: the path of a page that shows it by itself, with the docstring's first line as what it changes.
    """

    run: Callable[..., Done]
    path: str
    command: str = ""
    needs: Scope = Scope.CHANGE
    answer: str = "ServiceState"
    page: str = ""

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """The parameters but the caller."""
        return dict([*signature(self.run, eval_str=True).parameters.items()][1:])


OPERATIONS: dict[str, Operation] = {}


def operation(path: str, command: str = "", **more: Any) -> Callable[[Callable[..., Done]], Callable[..., Done]]:
    """Make an `Operation` of a function, by its name."""

    def add(run: Callable[..., Done]) -> Callable[..., Done]:
        OPERATIONS[run.__name__] = Operation(run, path, command, **more)
        return run

    return add
