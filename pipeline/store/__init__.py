"""Keys and the feature store: the only door to Zarr."""

from pipeline.store.backends import LocalStoreConfig, MemoryStoreConfig, S3StoreConfig, StoreConfig
from pipeline.store.entries import DamagedEntry, Entry, Layout, Store
from pipeline.store.keys import Ref, make_ref

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
