"""Datasets of the paper: their archives located, downloaded, checked and unpacked as ``dataset=`` reads them."""

from pipeline.fetch.catalog import DATASETS
from pipeline.fetch.dataset import fetch_dataset, fetch_photographs
from pipeline.fetch.sources import FolderSource, HubSource, Source, UrlSource

__all__ = [
    "DATASETS",
    "FolderSource",
    "HubSource",
    "Source",
    "UrlSource",
    "fetch_dataset",
    "fetch_photographs",
]
