"""What is published where: archives and default detections of each dataset, with their sizes and digests.

Names are those of the hub's dataset repositories ``bop-benchmark/...``, where the BOP benchmark serves its files.
A size or digest that is None is not pinned here; the hub states both for every file.
"""

from __future__ import annotations

from dataclasses import dataclass

HUB = "bop-benchmark"
_DETECTIONS = "default_detections/classic_bop23_model_based_unseen/cnos-fastsam"
DETECTIONS_LICENCE = "bop-extra-license (the terms of bop-benchmark/bop_extra)"


@dataclass(frozen=True)
class RemoteFile:
    """A published file: hub repository, path in it and revision; ``nbytes`` and ``sha256`` of the checked version."""

    repo: str
    path: str
    revision: str = "main"
    nbytes: int | None = None
    sha256: str | None = None

    @property
    def name(self) -> str:
        """File name without folders."""
        return self.path.rsplit("/", 1)[-1]


@dataclass(frozen=True)
class PublishedDataset:
    """A dataset's files and what its BOP test set has.

    ``split``, ``models``: its folders of scenes and meshes; ``unpacked_bytes``: about; ``instances``: of all targets.
    """

    name: str
    title: str
    licence: str
    split: str
    models: str
    unpacked_bytes: int
    objects: int
    images: int
    instances: int
    archives: tuple[RemoteFile, ...]
    detections: RemoteFile


def _lmo() -> PublishedDataset:
    repo = f"{HUB}/lmo"
    archives = (
        RemoteFile(repo, "lmo_base.zip", nbytes=5_684),
        RemoteFile(repo, "lmo_models.zip", nbytes=5_367_178),
        RemoteFile(
            repo,
            "lmo_test_bop19.zip",
            nbytes=117_550_985,
            sha256="42d7a15f317476ca3980ee7ec0344b691cbadc796835f0b14f72c89a1dcec421",
        ),
    )
    detections = RemoteFile(
        f"{HUB}/bop_extra",
        f"{_DETECTIONS}/cnos-fastsam_lmo-test_3cb298ea-e2eb-4713-ae9e-5a7134c5da0f.json",
        nbytes=12_183_654,
    )
    return PublishedDataset(
        "lmo", "LM-O", "CC BY-SA 4.0", "test", "models", 150_000_000, 8, 200, 1445, archives, detections
    )


def _ycbv() -> PublishedDataset:
    repo, revision = f"{HUB}/ycbv", "5c2c4aa229800355648cd268040aa814f8dc94f0"
    archives = (
        RemoteFile(
            repo,
            "ycbv_base.zip",
            revision,
            nbytes=15_805,
            sha256="98440f8bd403100b21cf11a6729fabe8b3d5ce714472edc57a18b7f1fcd4bb18",
        ),
        RemoteFile(repo, "ycbv_models.zip", revision, nbytes=524_634_729),
        RemoteFile(
            repo,
            "ycbv_test_bop19.zip",
            revision,
            nbytes=660_198_701,
            sha256="c0c11251849877e7b2f373f6c7acf54739dc69d0fb2649c20050ca977bf5513d",
        ),
    )
    detections = RemoteFile(
        f"{HUB}/bop_extra", f"{_DETECTIONS}/cnos-fastsam_ycbv-test_f4f2127c-6f59-447c-95b3-28e1e591f1a1.json"
    )
    return PublishedDataset(
        "ycbv", "YCB-V", "MIT", "test", "models", 1_700_000_000, 21, 900, 4123, archives, detections
    )


def _tless() -> PublishedDataset:
    repo, revision = f"{HUB}/tless", "5fd309a04476a842d93abfb584fba9ee7caecdf1"
    archives = (
        RemoteFile(
            repo,
            "tless_base.zip",
            revision,
            nbytes=49_597,
            sha256="dd70ca884b7c471a530a952f70c5ab2c212f3d2c2f371be86397442b97d70a7e",
        ),
        RemoteFile(
            repo,
            "tless_models.zip",
            revision,
            nbytes=33_468_762,
            sha256="6a29c59766b8d2af05e62e71739f0ca7243ad81bc3c7f9a24925504a8cb37928",
        ),
        RemoteFile(
            repo,
            "tless_test_primesense_bop19.zip",
            revision,
            nbytes=825_276_992,
            sha256="1a18f6bbfb5ac4ced8529f7a35225adfed88c0f62ef38067933e2b541ef1d00b",
        ),
    )
    detections = RemoteFile(
        f"{HUB}/bop_extra", f"{_DETECTIONS}/cnos-fastsam_tless-test_8ca61cb0-4472-4f11-bce7-1362a12d396f.json"
    )
    return PublishedDataset(
        "tless",
        "T-LESS",
        "CC BY 4.0",
        "test_primesense",
        "models_cad",
        1_000_000_000,
        30,
        1000,
        6423,
        archives,
        detections,
    )


DATASETS = {dataset.name: dataset for dataset in (_lmo(), _ycbv(), _tless())}
