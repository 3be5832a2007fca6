"""What lies on disk: cached artefacts, finished runs and the sweeps that they belong to.

Everything is written under a temporary name and renamed, so that a reader finds it whole or not at all.
"""

from dadiff.store.cache import Cache, Entry
from dadiff.store.folder import is_read_only, store_id
from dadiff.store.record import DONE, Provenance, Record, Status
from dadiff.store.results import Results, StoredRun
from dadiff.store.sweeps import Lease, Sweep, Sweeps, SweptRun

__all__ = [
    "DONE",
    "Cache",
    "Entry",
    "Lease",
    "Provenance",
    "Record",
    "Results",
    "Status",
    "StoredRun",
    "Sweep",
    "Sweeps",
    "SweptRun",
    "is_read_only",
    "store_id",
]
