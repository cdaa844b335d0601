"""crops -> feature maps of a latent diffusion model's decoder: the base of such extractors.

Tang et al., NeurIPS 2023 (DIFT) and Zhang et al., NeurIPS 2023 (A Tale of Two Features): encode the image, noise the
latent once, run the U-Net once, read its decoder.
"""

from __future__ import annotations

import copy
import threading
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import interpolate

from pipeline.backbones.batching import Footprint, Passes, choose_cpu_pass, maps_bytes
from pipeline.backbones.determinism import use_deterministic_convolutions
from pipeline.backbones.extractor import Extractor
from pipeline.backbones.stable_diffusion.decoder import Hook, count_blocks, map_shape, read_decoder_maps
from pipeline.backbones.stable_diffusion.noise import NoiseMode, add_noise, draw_noise
from pipeline.errors import BadInput
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Dtype, NonNegative, Positive, Runtime, spec

_MOST_CROPS = {"cpu": 16, "cuda": 64}
_VAE_VALUES, _MOST_IN_VAE = 1 << 20, 4  # values of a VAE's first map, 4 MB in float32; and images, at a time on a CPU


@dataclass(frozen=True, eq=False)
class DiffusionConfigs:
    """A model's diffusers configs of U-Net and VAE, and abar_t of its noise schedule."""

    unet: Mapping[str, Any]
    vae: Mapping[str, Any]
    alphas_cumprod: Float[np.ndarray, " timesteps"]

    @property
    def vae_factor(self) -> int:
        """Image pixels per latent cell, along one side."""
        return 1 << (len(self.vae["block_out_channels"]) - 1)

    @property
    def size_step(self) -> int:
        """Pixels that input sizes must be a multiple of, so that encoder and decoder maps have equal sizes."""
        return self.vae_factor << (len(self.unet["block_out_channels"]) - 1)


@dataclass(frozen=True, eq=False)
class LoadedModel:
    """A diffusion model in memory, on the CPU, in the spec's dtype. ``prompt``: the text embedding (1 l d)."""

    unet: nn.Module
    vae: nn.Module
    prompt: Float[Tensor, "1 l d"]


@spec
class DiffusionFeatures(Extractor):
    """Base of all latent diffusion extractors, with their common parameters.

    ``hook``: what "layer k" means (``decoder.find_tapped_module``). ``noise="none"``: the U-Net gets the clean latent,
    without noise and unscaled, at the same timestep. ``ensemble``: features are averaged over that many noise samples,
    drawn with ``seed``, ``seed`` + 1, ...
    """

    hook: Hook = "pre"
    input_size: Positive = 512
    timestep: NonNegative = 50
    noise: NoiseMode = "shared"
    seed: NonNegative = 0
    ensemble: Positive = 1
    dtype: Dtype = "float32"

    @property
    @abstractmethod
    def configs(self) -> DiffusionConfigs:
        """The model's configs; no weights are loaded."""

    @abstractmethod
    def load_model(self) -> LoadedModel:
        """The model with its weights, on the CPU."""

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe; without noise its seed and the ensemble have no effect and get fixed values."""
        return super().recipe() | ({"seed": 0, "ensemble": 1} if self.noise == "none" else {})

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w) of one crop's map. Raises BadInput for a layer, timestep or input size the model does not have."""
        configs = self.configs
        _check(self, configs, (layer,))
        latent_size = self.input_size // configs.vae_factor
        return map_shape(configs.unet, layer=layer, hook=self.hook, latent_size=latent_size)

    def load(self, runtime: Runtime) -> DiffusionBackbone:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
        configs = self.configs
        _check(self, configs, ())
        device = torch.device(runtime.torch_device())
        model = self.load_model()
        placed = LoadedModel(_place(model.unet, device), _place(model.vae, device), model.prompt.to(device))
        passes = Passes.choose(_pass_footprint(self, configs, device.type), runtime, device)
        return DiffusionBackbone(self, configs, placed, passes)

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As Extractor.footprint; weights are counted on meta tensors, which take no memory."""
        from diffusers import AutoencoderKL, UNet2DConditionModel

        passes = _pass_footprint(self, self.configs, device)
        _check(self, self.configs, layers)
        values = count_parameters(UNet2DConditionModel, self.configs.unet)
        values += count_parameters(AutoencoderKL, self.configs.vae, without="decoder")
        maps = maps_bytes([self.feature_shape(layer) for layer in layers])
        return replace(
            passes, weight_bytes=values * _bytes_per_value(self), bytes_per_crop=passes.bytes_per_crop + maps
        )


class DiffusionBackbone:
    """A DiffusionFeatures spec with its model in memory."""

    def __init__(self, spec: DiffusionFeatures, configs: DiffusionConfigs, model: LoadedModel, passes: Passes) -> None:
        self.spec, self.configs, self.model, self.passes = spec, configs, model, passes
        self._thread = threading.local()

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers in the spec's dtype, on the model's device."""
        self.check(layers)
        with use_deterministic_convolutions():
            return self.passes.run(partial(self.run_pass, layers=layers), crops, layers)

    def check(self, layers: Sequence[int]) -> None:
        """Raise BadInput for a layer that the model does not have."""
        _check(self.spec, self.configs, layers)

    @torch.inference_mode()
    def run_pass(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of crops that pass the networks together."""
        latent = self._encode(crops.rgb)
        members = 1 if self.spec.noise == "none" else self.spec.ensemble
        return _average([self._extract_maps(crops, latent, self.spec.seed + i, layers) for i in range(members)])

    @property
    def _unet(self) -> nn.Module:
        """The U-Net for this thread: the weights are shared, the hooks that read its blocks are not."""
        if not hasattr(self._thread, "unet"):
            self._thread.unet = copy_structure(self.model.unet)
        unet: nn.Module = self._thread.unet
        return unet

    def _encode(self, rgb: UInt8[np.ndarray, "n S S 3"]) -> Float[Tensor, "n c h w"]:
        step = _vae_pass(self.spec, self.configs) if self.model.prompt.device.type == "cpu" else len(rgb)
        images = [self._prepare_image(rgb[i : i + step]) for i in range(0, len(rgb), step)]
        return torch.cat([encode_latent(self.model.vae, self.configs.vae, image) for image in images])

    def _prepare_image(self, rgb: UInt8[np.ndarray, "n S S 3"]) -> Float[Tensor, "n 3 H W"]:
        image = torch.from_numpy(np.ascontiguousarray(rgb)).to(self.model.prompt.device)
        return to_network_image(image, size=self.spec.input_size).to(self.model.prompt.dtype)

    def _extract_maps(
        self, crops: Crops, latent: Float[Tensor, "n c h w"], seed: int, layers: Sequence[int]
    ) -> FeatureMaps:
        s = self.spec
        if s.noise != "none":
            shape = (latent.shape[1], latent.shape[2], latent.shape[3])
            noise = draw_noise(s.noise, crops.rgb, crops.mask, seed=seed, shape=shape).to(latent)
            latent = add_noise(latent, noise, alpha_cumprod=float(self.configs.alphas_cumprod[s.timestep]))
        return read_decoder_maps(self._unet, latent, s.timestep, self.model.prompt, layers=layers, hook=s.hook)


def copy_structure(model: nn.Module) -> nn.Module:
    """A copy of a model that shares its tensors."""
    tensors = chain(model.parameters(), model.buffers())
    return copy.deepcopy(model, {id(tensor): tensor for tensor in tensors})


def to_network_image(rgb: UInt8[Tensor, "n S S 3"], *, size: int) -> Float[Tensor, "n 3 H W"]:
    """Images in [-1, 1], resized so that image edges coincide (camera.resize_affine); shrinking is antialiased."""
    image = rgb.permute(0, 3, 1, 2).float() / 127.5 - 1
    if image.shape[-1] == size:
        return image
    return interpolate(image, (size, size), mode="bilinear", align_corners=False, antialias=image.shape[-1] > size)


def encode_latent(vae: Any, config: Mapping[str, Any], image: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n c h w"]:
    """(posterior mean - shift_factor) * scaling_factor (Rombach et al., CVPR 2022, App. G); nothing is sampled."""
    mean = vae.encode(image).latent_dist.mean
    return (mean - (config.get("shift_factor") or 0.0)) * config.get("scaling_factor", 0.18215)


def _average(members: Sequence[FeatureMaps]) -> FeatureMaps:
    if len(members) == 1:
        return members[0]
    return {k: torch.stack([maps[k].float() for maps in members]).mean(0).to(members[0][k].dtype) for k in members[0]}


def _place(model: Any, device: torch.device) -> nn.Module:
    placed: nn.Module = model.eval().requires_grad_(False).to(device, memory_format=torch.channels_last)
    return placed


def _check(spec: DiffusionFeatures, configs: DiffusionConfigs, layers: Sequence[int]) -> None:
    blocks, timesteps, step = count_blocks(configs.unet), len(configs.alphas_cumprod), configs.size_step
    for layer in layers:
        if not 0 <= layer < blocks:
            raise BadInput("extract layer", found=layer, needed=f"0..{blocks - 1}, the U-Net's {blocks} decoder blocks")
    if spec.timestep >= timesteps:
        raise BadInput("extract.timestep", found=spec.timestep, needed=f"0..{timesteps - 1}, as the model was trained")
    if spec.input_size % step:
        raise BadInput(
            "extract.input_size", found=spec.input_size, needed=f"a multiple of {step} pixels for this model"
        )


def count_parameters(cls: Any, config: Mapping[str, Any], *, without: str = "") -> int:
    """Parameters of a diffusers model, not counting the part named ``without``; no memory is allocated."""
    with torch.device("meta"):
        model = cls.from_config(dict(config))
    return sum(p.numel() for name, p in model.named_parameters() if not without or not name.startswith(without))


def _bytes_per_value(spec: DiffusionFeatures) -> int:
    return 4 if spec.dtype == "float32" else 2


def _vae_pass(spec: DiffusionFeatures, configs: DiffusionConfigs) -> int:
    """Images that the VAE encodes at a time on the CPU: its first maps are the largest of all, and fit in the cache."""
    values = configs.vae["block_out_channels"][0] * spec.input_size**2
    return max(1, min(_VAE_VALUES // values, _MOST_IN_VAE))


def _pass_footprint(spec: DiffusionFeatures, configs: DiffusionConfigs, device: str) -> Footprint:
    """Estimate of a pass from its largest maps: the VAE's first level (few images on a CPU), the U-Net's with skips."""
    latent_size = spec.input_size // configs.vae_factor
    unet = 60 * configs.unet["block_out_channels"][0] * latent_size**2 * _bytes_per_value(spec)
    vae = 6 * configs.vae["block_out_channels"][0] * spec.input_size**2 * _bytes_per_value(spec)
    if device == "cuda":
        return Footprint(0, 0, unet + vae, _MOST_CROPS[device])
    bytes_per_pass, max_batch = max(0, _vae_pass(spec, configs) * vae - unet), _MOST_CROPS[device]
    return Footprint(0, bytes_per_pass, unet, max_batch, choose_cpu_pass(bytes_per_pass, unet, max_batch))
