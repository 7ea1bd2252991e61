"""The routes of operations: what a request tells, checked by the parameters' annotations, becomes the call of one."""

from inspect import Parameter, Signature, signature
from typing import Annotated, Any, get_args

from fastapi import APIRouter, Response
from pydantic import Field, create_model
from typer.models import ArgumentInfo

from mapserver.api import parameters as p
from mapserver.api import views
from mapserver.api.guard import Sender
from mapserver.api.operations import OPERATIONS, Caller, Operation

_PARTS: dict[str, Any] = {"site": p.Site, "version": p.Version, "robot": p.Robot}
_PARTS |= {"operator": p.Operator, "token": p.TokenNumber, "asked": p.RequestId}


def router_of_operations() -> APIRouter:
    """Return the routes of all operations."""
    router = APIRouter()
    for operation in OPERATIONS.values():
        model, tag = getattr(views, operation.answer), operation.run.__module__.rpartition(".")[2]
        answer: Any = {"response_class": Response} if model is views.Bundle else {"response_model": model}
        router.post(operation.path, tags=[tag], **answer)(_endpoint(operation, model))
    return router


def _endpoint(operation: Operation, model: Any) -> Any:
    """The function of a route, with parts of its address and a body."""
    told = {name: item for name, item in operation.parameters.items() if item.kind is not Parameter.KEYWORD_ONLY}
    several = {name for name, item in told.items() if _is_one_of_several(item)}
    parts = {name: _PARTS.get(name, item.annotation) for name, item in told.items() if f"{{{name}}}" in operation.path}
    fields: Any = {name: _field(item) for name, item in told.items() if name not in parts}
    title = operation.run.__name__.title().replace("_", "")
    body = create_model(f"{title}Act", __base__=views.Act, __doc__=operation.run.__doc__, **fields)

    def endpoint(*, service: p.Service, sender: Sender, response: Response, act: body, **named: Any) -> Any:  # type: ignore[valid-type]
        response.headers["Cache-Control"] = "no-store"  # some answers are the only one with a secret
        caller = Caller(service.store, sender.of(act), service.settings.config, service, sender.who)
        named |= {name: getattr(act, name) for name in fields}
        done = operation.run(caller, **{name: [value] if name in several else value for name, value in named.items()})
        answer = views.OK if done.answer is None else done.answer
        return model.of(service, answer) if hasattr(model, "of") else answer

    (*general, _) = signature(endpoint).parameters.values()
    named = [Parameter(name, Parameter.KEYWORD_ONLY, annotation=kind) for name, kind in parts.items()]
    endpoint.__name__, endpoint.__doc__ = operation.run.__name__, operation.run.__doc__
    endpoint.__signature__ = Signature([*general, *named])  # type: ignore[attr-defined]
    return endpoint


def _is_one_of_several(parameter: Parameter) -> bool:
    """True for an argument that a command takes several of; a request names one of them."""
    kind, *notes = get_args(parameter.annotation)
    return kind == list[str] and any(isinstance(note, ArgumentInfo) for note in notes)


def _field(parameter: Parameter) -> tuple[Any, Any]:
    """A field of a body: its type with what is said of it, and its default."""
    kind, *notes = get_args(parameter.annotation)
    kind = str if _is_one_of_several(parameter) else kind
    said: dict[str, Any] = {}
    for note in notes:
        said |= note if isinstance(note, dict) else {"description": note.help, "ge": note.min, "le": note.max}
    return Annotated[kind, Field(**said)], ... if parameter.default is Parameter.empty else parameter.default
