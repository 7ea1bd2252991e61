"""Maps on the disk: content-addressed files and one database. All SQL is here."""

from mapserver.store.database import chain_faults as chain_faults
from mapserver.store.fleet_queries import CounterKey as CounterKey
from mapserver.store.fleet_queries import FleetBatch as FleetBatch
from mapserver.store.fleet_queries import tile_key as tile_key
from mapserver.store.map_store import MapStore as MapStore
from mapserver.store.operators import OperatorQueries as OperatorQueries
from mapserver.store.queries import EVER as EVER
from mapserver.store.rows import *  # noqa: F403
from mapserver.store.usage import DiskSpace as DiskSpace
from mapserver.store.usage import StoreUsage as StoreUsage
