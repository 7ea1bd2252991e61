"""Operations on incidents. What is done is a line of the log, from which the incident's state follows."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from fleetmap.errors import InvalidValueError, StateError
from mapserver.api.operations.operation import Caller, Done, operation

Id = Annotated[
    str,
    {"max_length": 500, "examples": ["failure/hall/1"]},
    Argument(metavar="INCIDENT", help="The incident, as `incidents list` shows it."),
]
_NAME = r"^[\w.@+|/=~'-]+([ :][\w.@+|/=~'-]+)*$"
_MOST_SIGNS = 64
Owner = Annotated[
    str,
    {"pattern": _NAME, "max_length": _MOST_SIGNS, "examples": ["bob"]},
    Option("--to", metavar="NAME", help="Who has it from now on."),
]
InboxFolder = Annotated[Path | None, Option(metavar="DIR", help="Folder of the inboxes, for recordings.")]


@operation("/v1/incidents/acknowledge", "incidents acknowledge")
def acknowledge(caller: Caller, incident: Id, *, inbox: InboxFolder = None) -> Done:
    """Take an open incident on. Its alert is sent no more, until it ends and begins anew."""
    return _noted(caller, incident, "acknowledged", inbox, ("open",))


@operation("/v1/incidents/assign", "incidents assign")
def assign(caller: Caller, incident: Id, to: Owner, *, inbox: InboxFolder = None) -> Done:
    """Hand an incident to somebody, who has it from now on; nobody needs to acknowledge it any more."""
    if not (re.fullmatch(_NAME, to) and len(to) <= _MOST_SIGNS):
        raise InvalidValueError(f"{to[:80]!r} is no name; write one such as bob")
    return _noted(caller, incident, f"handed to {to}", inbox)


@operation("/v1/incidents/comment", "incidents comment")
def comment(caller: Caller, incident: Id, *, inbox: InboxFolder = None) -> Done:
    """Add the reason to what is known of an incident; its state stays."""
    if not caller.actor.reason.strip():
        raise InvalidValueError("a comment is the `reason` of its act; write one")
    return _noted(caller, incident, "commented", inbox, ("open", "acknowledged", "closed"))


@operation("/v1/incidents/close", "incidents close")
def close(caller: Caller, incident: Id, *, inbox: InboxFolder = None) -> Done:
    """Close an incident that needs nobody any more: lists leave it out."""
    return _noted(caller, incident, "closed", inbox)


@operation("/v1/incidents/reopen", "incidents reopen")
def reopen(caller: Caller, incident: Id, *, inbox: InboxFolder = None) -> Done:
    """Open an incident again, for anybody; if it is an alert that goes on, it is sent again."""
    return _noted(caller, incident, "reopened", inbox, ("acknowledged", "closed"))


def _noted(
    caller: Caller, incident: str, act: str, inbox: Path | None, states: Sequence[str] = ("open", "acknowledged")
) -> Done:
    """Log an act on an incident in one of these states."""
    from mapserver.api.incidents import find
    from mapserver.fleet.alerts import with_acts
    from mapserver.fleet.fleet import Fleet
    from mapserver.store import INCIDENT

    store, served = caller.store, caller.served
    fleet, inbox = (Fleet(store), inbox) if served is None else (served.fleet, served.settings.inbox)
    found = find(incident, store, fleet, caller.config.alerts, inbox)
    with store.locked("incidents.lock"):  # of two people who take one on at once, the second learns who has it
        (now,) = with_acts(store, [found])
        if now.state not in states:
            who = f", and {now.assignee} has it" if now.assignee else ""
            raise StateError(f"{found.id} is {now.state}{who}; look at it again, `incidents list` shows all")
        store.audit(INCIDENT, f"{act}: {found.id}", actor=caller.actor, site=found.site)
    return Done(f"{found.id} is {act}")
