"""query and template features -> one map each, by the head trained with the embedded model and the crops' edges."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.errors import BadInput
from pipeline.functional.aggregation import Aggregation
from pipeline.functional.gradients import EDGES, append_edges
from pipeline.io.digests import file_digest
from pipeline.items.features import FusedPair
from pipeline.spec import PositiveFloat, Spec, spec
from pipeline.stages.fuse import Layers, fused

LAYERS = (2, 5, 8, 11)
WITH_EDGES = (*LAYERS, EDGES)
HEAD = Path(__file__).parents[2] / "embedded" / "weights" / "head.safetensors"


@spec
class Learned(Spec):
    """Descriptors of a trained aggregation of all layers (after Luo et al., "Diffusion Hyperfeatures", NeurIPS 2023).

    Layer 12, the crop's own gradient histograms, stands beside them with the weight ``edges``: the descriptors tell
    places apart, edges say where exactly. Without 12 among the ``layers``, descriptors are alone. Goes with
    ``extract=embedded extract.weights=learned``, whose features it was trained on, and with no other.
    """

    kind: ClassVar[str] = "fuse.learned"
    version: ClassVar[int] = 2

    layers: Layers = WITH_EDGES
    edges: PositiveFloat = 1.5

    @staticmethod
    def suits(model: str) -> bool:
        """Whether the head was trained on the features of an extractor's ``model``."""
        return model.startswith("embedded-learned-")

    def check(self, model: str) -> None:
        """Raise BadInput for features that the head was not trained on, and for a choice of their layers."""
        if not self.suits(model):
            needed = "extract=embedded extract.weights=learned, or fuse=auto or pca for other features"
            raise BadInput("fuse=learned", found=f"features of {model}", needed=needed)
        if self.layers not in (LAYERS, WITH_EDGES):
            needed = f"{list(WITH_EDGES)} for fuse=learned, or {list(LAYERS)} without edges"
            raise BadInput("fuse.layers", found=list(self.layers), needed=needed)

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the digest of the head's weights; without edges, their weight cannot matter."""
        known = super().recipe() | {"weights": _digest()}
        return known if EDGES in self.layers else known | {"edges": 0.0}

    def __call__(
        self,
        query: Mapping[int, Float[Tensor, "c h w"]],
        template: Mapping[int, Float[Tensor, "c h w"]],
        query_mask: Bool[Tensor, "S S"],
        template_mask: Bool[Tensor, "S S"],
    ) -> FusedPair:
        """Fused maps. Raises NoPose for an empty mask."""
        return fused(self.side(query), self.side(template), query_mask, template_mask)

    def side(self, features: Mapping[int, Float[Tensor, "c h w"]]) -> Float[Tensor, "d h w"]:
        """One side's map; the other has no say in it."""
        maps = {layer: features[layer][None].float() for layer in self.layers}
        with torch.no_grad():
            described = _head(features[self.layers[0]].device)(maps)
            if EDGES in maps:
                described = append_edges(described, maps[EDGES], weight=self.edges)
        return described[0]


@lru_cache(maxsize=2)
def _head(device: torch.device) -> Aggregation:
    from safetensors.torch import load_file

    _there()
    state = {name: tensor.float() for name, tensor in load_file(HEAD).items()}
    channels = {layer: state[f"mix.{k}.weight"].shape[1] for k, layer in enumerate(LAYERS)}
    head = Aggregation(channels, state["narrow.weight"].shape[0])
    head.load_state_dict(state)
    return head.eval().requires_grad_(False).to(device)


@lru_cache(maxsize=1)
def _digest() -> str:
    _there()
    return file_digest(HEAD)


def _there() -> None:
    if not HEAD.exists():
        raise BadInput(HEAD, found="nothing", needed="the embedded model's head (make train-embedded), or fuse=pca")
