"""The operations on a site, on incidents and on people's accounts."""

from mapserver.api.operations import incidents, people, sites
from mapserver.api.operations.operation import OPERATIONS, Caller, Operation

__all__ = ["OPERATIONS", "Caller", "Operation", "incidents", "people", "sites"]
