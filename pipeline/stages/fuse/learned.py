"""query and template features -> one map each, by the trained head of the embedded model, with gradient histograms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, ClassVar

import torch

from pipeline.backbones.extractor import Extractor
from pipeline.errors import BadInput
from pipeline.functional.aggregation import Aggregation
from pipeline.functional.gradients import EDGES, NEIGHBOURHOOD, append_edges
from pipeline.functional.maps import put_channels_last
from pipeline.functional.masks import cell_mask
from pipeline.io.checkpoints import read_json
from pipeline.io.digests import FileChanged, file_digest
from pipeline.io.files import read_file
from pipeline.items.features import CropFeatures, FittedArrays, FusedPair
from pipeline.spec import PositiveFloat, spec
from pipeline.stages.fuse import EncodedMap, Fuser, Layers, pair_encoded

LAYERS = (2, 5, 8, 11)
WITH_EDGES = (*LAYERS, EDGES)
HEAD = Path(__file__).parents[2] / "embedded" / "weights" / "head.safetensors"
TRAINED_ON = HEAD.with_suffix(".json")
"""Recipe of the extractor that the head was trained on, without version and dtype, which may differ."""


@spec
class Learned(Fuser[EncodedMap]):
    """Descriptors of a trained aggregation of all layers (after Luo et al., "Diffusion Hyperfeatures", NeurIPS 2023).

    Layer 12, gradient histograms of the crop, is appended with the weight ``edges``: descriptors distinguish places,
    gradients localise them. Without 12 among the ``layers``, descriptors are used alone. Works only with the features
    it was trained on: ``extract=embedded extract.weights=learned`` with its hook, timestep, noise and input size.
    """

    kind: ClassVar[str] = "fuse.learned"
    version: ClassVar[int] = 2

    layers: Layers = WITH_EDGES
    edges: PositiveFloat = 1.5

    @staticmethod
    def suits(model: str) -> bool:
        """Whether the head was trained on the features of an extractor's ``model``."""
        return model.startswith("embedded-learned-")

    def check(self, extract: Extractor) -> None:
        """Raise BadInput for features that the head was not trained on, and for a subset of their layers."""
        if not self.suits(extract.model):
            needed = "extract=embedded extract.weights=learned, or fuse=auto or pca for other features"
            raise BadInput("fuse=learned", found=f"features of {extract.model}", needed=needed)
        recipe = extract.recipe()
        for name, value in _read_trained_on().items():
            if recipe.get(name) != value:
                needed = f"{value!r}, as the head of fuse=learned was trained; or fuse=pca, as in method=dzop"
                raise BadInput(f"extract.{name}", found=repr(recipe.get(name)), needed=needed)
        if self.layers not in (LAYERS, WITH_EDGES):
            needed = f"{list(WITH_EDGES)} for fuse=learned, or {list(LAYERS)} without gradient histograms"
            raise BadInput("fuse.layers", found=list(self.layers), needed=needed)

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the digest of the head's weights; ``edges`` is 0 without gradient histograms."""
        known = super().recipe() | {"weights": self.weights_digest}
        return known if EDGES in self.layers else known | {"edges": 0.0}

    @cached_property
    def weights_digest(self) -> str:
        """sha256 of the head's weights. Raises BadInput if they are missing."""
        _require_head()
        return file_digest(HEAD)

    def encoded_shape(self, shapes: Mapping[int, tuple[int, int, int]]) -> tuple[int, int, int]:
        """The head's channels, and 9 histograms where there are edges, at twice the resolution of the finest layer."""
        cells = 2 * max(shapes[layer][1] for layer in LAYERS)
        edges = NEIGHBOURHOOD * shapes[EDGES][0] if EDGES in self.layers else 0
        return head_channels(self.weights_digest) + edges, cells, cells

    def encode(self, crop: CropFeatures, fitted: FittedArrays) -> EncodedMap:
        """The head's map, with the gradient histograms beside it."""
        maps = {layer: put_channels_last(crop.maps[layer]).float()[None] for layer in self.layers}
        with torch.no_grad():
            described = _head(maps[self.layers[0]].device, self.weights_digest)(maps)
            if EDGES in maps:
                described = append_edges(described, maps[EDGES], weight=self.edges)
        return EncodedMap(put_channels_last(described[0]), cell_mask(crop.mask, cells=described.shape[-1]))

    def pair(self, query: EncodedMap, template: EncodedMap) -> FusedPair:
        """Fused maps. Raises NoPose for an empty mask."""
        return pair_encoded(query, template)


def head_channels(weights_digest: str) -> int:
    """Channels of the head's descriptors."""
    return _head(torch.device("cpu"), weights_digest).narrow.out_channels


@lru_cache(maxsize=2)
def _head(device: torch.device, weights_digest: str) -> Aggregation:
    """The head with the weights of this digest. Raises FileChanged if its file has others."""
    from safetensors.torch import load

    content = read_file(HEAD, "the embedded model's head")
    if sha256(content).hexdigest() != weights_digest:
        raise FileChanged(str(HEAD))
    state = {name: tensor.float() for name, tensor in load(content).items()}
    channels = {layer: state[f"mix.{k}.weight"].shape[1] for k, layer in enumerate(LAYERS)}
    head = Aggregation(channels, state["narrow.weight"].shape[0])
    head.load_state_dict(state)
    untyped: Any = head.eval().requires_grad_(False)  # torch's signature of to() lacks memory_format
    placed: Aggregation = untyped.to(device, memory_format=torch.channels_last)
    return placed


def _read_trained_on() -> dict[str, Any]:
    _require_head()
    return read_json(TRAINED_ON)


def _require_head() -> None:
    for path in (HEAD, TRAINED_ON):
        if not path.exists():
            raise BadInput(path, found="nothing", needed="the embedded model's head (make train-embedded), or fuse=pca")
