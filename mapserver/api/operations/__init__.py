"""The operations on a site and on people's accounts."""

from mapserver.api.operations import people, sites
from mapserver.api.operations.operation import OPERATIONS, Caller, Operation

__all__ = ["OPERATIONS", "Caller", "Operation", "people", "sites"]
