"""crops -> feature maps of the small latent diffusion model that ships with the package; nothing is downloaded.

Layers 0 to 11 are the decoder's blocks. Layer 12 holds gradient histograms of the crop, which restore detail that the
decoder's cells of 4 px lose.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.backbones.batching import Footprint, maps_bytes
from pipeline.backbones.stable_diffusion.configs import alphas_cumprod
from pipeline.backbones.stable_diffusion.features import (
    DiffusionBackbone,
    DiffusionConfigs,
    DiffusionFeatures,
    LoadedModel,
)
from pipeline.backbones.stable_diffusion.loading import allocate_encoder, allocate_unet
from pipeline.backbones.stable_diffusion.noise import NoiseMode
from pipeline.errors import BadInput
from pipeline.functional.gradients import EDGES, ORIENTATIONS, edge_histograms
from pipeline.io.digests import file_digest
from pipeline.io.files import read_file
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Positive, Runtime, digest, spec

FOLDER = Path(__file__).parents[2] / "embedded" / "weights"
_EDGES_PASS = 4  # crops whose histograms are computed at a time on a CPU: their gradients fit in its cache
PROMPT = (1, 1, 32)  # the model was trained without text: its prompt is zeros

WeightSet = Literal["learned", "pure"]


@spec
class Embedded(DiffusionFeatures):
    """A latent diffusion model of Stable Diffusion's architecture and 1/200 of its size, trained on procedural objects.

    ``weights``: ``pure`` was trained to remove noise only; ``learned`` was then trained further on exact
    correspondences of rendered pairs, together with the head of ``fuse=learned``. See pipeline/embedded/README.md.
    """

    kind: ClassVar[str] = "extract.embedded"
    version: ClassVar[int] = 1
    notice: ClassVar[str] = (
        "note: features of the small embedded model, trained on procedural objects; these figures are not Stable "
        "Diffusion's (extract=stable_diffusion)"
    )

    weights: WeightSet = "learned"
    input_size: Positive = 128
    noise: NoiseMode = "none"

    @property
    def model(self) -> str:
        """``embedded-pure-`` or ``embedded-learned-`` and 8 digits of the digest of the weights."""
        return f"embedded-{self.weights}-{self.weights_digest[:8]}"

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """As DiffusionFeatures.feature_shape; layer 12 has 2 x 2 cells for each cell of the latent."""
        if layer != EDGES:
            return super().feature_shape(layer)
        cells = 2 * self.input_size // self.configs.vae_factor
        return ORIENTATIONS, cells, cells

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As DiffusionFeatures.footprint; histograms are computed after the passes, in less memory than a pass."""
        decoder = super().footprint(_decoder_layers(layers), crop_size, device)
        edges = [self.feature_shape(layer) for layer in layers if layer == EDGES]
        return replace(decoder, bytes_per_crop=decoder.bytes_per_crop + maps_bytes(edges))

    def load(self, runtime: Runtime) -> EmbeddedBackbone:
        """As DiffusionFeatures.load."""
        decoder = super().load(runtime)
        return EmbeddedBackbone(self, decoder.configs, decoder.model, decoder.passes)

    def recipe(self) -> dict[str, Any]:
        """As DiffusionFeatures.recipe, with the weights' digest after the name of the set."""
        return super().recipe() | {"weights": f"{self.weights} {self.weights_digest}"}

    @cached_property
    def configs(self) -> DiffusionConfigs:
        """Configs as shipped. Raises BadInput where the model is not installed."""
        path = FOLDER / "config.json"
        if not path.exists():
            raise BadInput(path, found="nothing", needed="the embedded model (make train-embedded), or another extract")
        config = json.loads(read_file(path, "the embedded model's config"))
        return DiffusionConfigs(config["unet"], config["vae"], alphas_cumprod(config["scheduler"]))

    def load_model(self) -> LoadedModel:
        """The shipped weights, float16 on disk."""
        dtype = getattr(torch, self.dtype)
        unet = _load_weights(allocate_unet(self.configs.unet, dtype), FOLDER / f"unet_{self.weights}.safetensors")
        vae = allocate_encoder(self.configs.vae, dtype)
        return LoadedModel(unet, _load_weights(vae, FOLDER / "vae.safetensors"), torch.zeros(PROMPT, dtype=dtype))

    @cached_property
    def weights_digest(self) -> str:
        """sha256 of configs and weights. Raises BadInput for a file that is missing."""
        return digest_weights(FOLDER, self.weights)


class EmbeddedBackbone(DiffusionBackbone):
    """The model in memory, with gradient histograms as an additional layer."""

    def check(self, layers: Sequence[int]) -> None:
        """Raise BadInput for a layer that neither the model nor the histograms have."""
        super().check(_decoder_layers(layers))

    @torch.inference_mode()
    def run_pass(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of crops that pass the networks together, and their histograms."""
        decoder_layers = _decoder_layers(layers)
        maps = super().run_pass(crops, decoder_layers) if decoder_layers else {}
        return {**maps, EDGES: self._compute_edges(crops)} if EDGES in layers else maps

    def _compute_edges(self, crops: Crops) -> Float[Tensor, "n 8 h w"]:
        device = self.model.prompt.device
        rgb, mask = (torch.from_numpy(np.ascontiguousarray(x)).to(device) for x in (crops.rgb, crops.mask))
        step = _EDGES_PASS if device.type == "cpu" else len(rgb)
        cells = self.spec.feature_shape(EDGES)[1]
        parts = zip(rgb.split(step), mask.split(step), strict=True)
        edges = torch.cat([edge_histograms(*part, cells=cells) for part in parts])
        return edges.to(getattr(torch, self.spec.dtype))


def digest_weights(folder: Path, weights: WeightSet) -> str:
    """sha256 of configs and weights in a folder. Raises BadInput for a file that is missing."""
    paths = [folder / name for name in ("config.json", f"unet_{weights}.safetensors", "vae.safetensors")]
    for path in paths:
        if not path.exists():
            raise BadInput(path, found="nothing", needed="the embedded model's weights (make train-embedded)")
    return digest([file_digest(path) for path in paths])


def _decoder_layers(layers: Sequence[int]) -> list[int]:
    return [layer for layer in layers if layer != EDGES]


def _load_weights(model: nn.Module, path: Path) -> nn.Module:
    from safetensors.torch import load

    wanted = model.state_dict()
    content = read_file(path, "the embedded model's weights")
    stored = {name: tensor for name, tensor in load(content).items() if name in wanted}
    model.load_state_dict({name: tensor.to(wanted[name].dtype) for name, tensor in stored.items()})
    return model
