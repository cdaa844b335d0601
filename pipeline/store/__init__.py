"""Cache keys and the feature store. Only this package imports Zarr."""

from pipeline.store.arrays import Layout
from pipeline.store.backends import LocalStoreConfig, MemoryStoreConfig, S3StoreConfig, StoreConfig
from pipeline.store.entry import DamagedEntry, Entry
from pipeline.store.keys import Ref, make_ref
from pipeline.store.store import Store

__all__ = [
    "DamagedEntry",
    "Entry",
    "Layout",
    "LocalStoreConfig",
    "MemoryStoreConfig",
    "Ref",
    "S3StoreConfig",
    "Store",
    "StoreConfig",
    "make_ref",
]
