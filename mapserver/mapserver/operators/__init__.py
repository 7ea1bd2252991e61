"""Operators with names: passwords, sessions and tokens, what each may do, and where the server may listen. docs/security.md explains it."""

from mapserver.operators.binding import HttpBinding, binding_fault
from mapserver.operators.operators import Operators
from mapserver.operators.roles import Identity, Role, Scope, check_operator_name

__all__ = ["HttpBinding", "Identity", "Operators", "Role", "Scope", "binding_fault", "check_operator_name"]
