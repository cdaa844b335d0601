"""crops -> feature maps of a self-supervised vision transformer: the base of such extractors.

Amir et al., ECCVW 2022 (Deep ViT Features as Dense Visual Descriptors): keys, queries, values or tokens of a block as a
map of descriptors; overlapping patches for finer maps; spatial bins around each cell for context.

Position of a token: the crop is padded with (patch - stride) / 2 black pixels on each side, so that the patch of token
(i, j) is centred on cell (i, j) of the input_size / stride equal cells that cover the crop, the convention of
``camera.cell_to_px``. Amir et al. do not pad: their first token lies half a patch from the border, and a map of equal
cells would misplace tokens by up to (patch - stride) / 2 pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.backbones.batching import Footprint, Passes, choose_cpu_pass, maps_bytes
from pipeline.backbones.determinism import use_deterministic_convolutions
from pipeline.backbones.extractor import Extractor
from pipeline.backbones.stable_diffusion.features import to_network_image
from pipeline.backbones.vit.source import TransformersFolder, VitSizes, open_folder
from pipeline.backbones.vit.transformer import Facet, embed_patches, pad_border, read_block_tokens, standardise
from pipeline.errors import BadInput
from pipeline.functional.binning import bin_count, log_bin
from pipeline.io.checkpoints import tensor_shapes
from pipeline.io.digests import files_digest
from pipeline.items.features import CLASS_FACET_LAYER, CLASS_TOKEN_LAYER, PSEUDO_LAYERS, SALIENCY_LAYER, FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Dtype, NonNegative, Positive, Runtime, spec

_MOST_CROPS = {"cpu": 16, "cuda": 64}
_LIVE_MAPS = 24  # maps of the model's width that are in memory at once in a block: projections, attention, MLP


@spec
class VitFeatures(Extractor):
    """Base of all transformer extractors, with their common parameters. Layer k is block k, from 0.

    ``weights``: a hub id (with an optional ``revision``) or a folder written by save_pretrained; the recipe holds the
    digest of the files instead of these two fields. ``stride``: px of the input from one token to the next, a divisor
    of the patch size; None: the patch size. ``binned``: layers whose cells have 1 + 8 ``hierarchy`` spatial bins
    (``functional.binning``). ``norm_last``: tokens of any block (not keys, queries or values) go through the model's
    last layer norm. ``saliency_heads``: heads of the last block whose attention gives SALIENCY_LAYER (1 h w), None for
    all. CLASS_TOKEN_LAYER (c 1 1) is the class token after the last layer norm, CLASS_FACET_LAYER (c 1 1) its key,
    query or value in the last block. ``local_size``: side of the input for ``binned`` layers and saliency, which are
    then read from a pass of their own; None: ``input_size``.
    """

    added: ClassVar[Mapping[str, Any]] = {"local_size": None}
    model_types: ClassVar[tuple[str, ...]]

    weights: str
    revision: str | None = None
    facet: Facet = "key"
    stride: Positive | None = None
    input_size: Positive = 224
    binned: tuple[NonNegative, ...] = ()
    hierarchy: Positive = 2
    norm_last: bool = False
    saliency_heads: tuple[NonNegative, ...] | None = None
    dtype: Dtype = "float32"
    local_size: Positive | None = None

    @cached_property
    def source(self) -> TransformersFolder:
        """Where the weights are; a hub id is downloaded first. Raises BadInput."""
        return open_folder(self.weights, self.revision, self.model_types, self.kind.partition(".")[2])

    @cached_property
    def sizes(self) -> VitSizes:
        """Sizes from the config; no weights are loaded. Raises BadInput for weights of another class."""
        return self.source.read_sizes()

    @cached_property
    def weights_digest(self) -> str:
        """sha256 of all files that the features depend on. Raises BadInput."""
        _ = self.sizes  # checked first, so that a folder of another class is refused by its class
        return files_digest(self.source.files)

    @property
    def model(self) -> str:
        """The variant's name and the first 8 digits of the weights' digest."""
        return f"{self.kind.partition('.')[2]}-{self.weights_digest[:8]}"

    @property
    def stride_px(self) -> int:
        """Pixels of the input from one token to the next."""
        return self.stride or self.sizes.patch

    def size_of(self, layer: int) -> int:
        """Side of the input (px) that a layer is read from."""
        local = self.local_size is not None and (layer in self.binned or layer == SALIENCY_LAYER)
        return (self.local_size if local else None) or self.input_size

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the weights' digest and the stride in pixels; fields without effect get fixed values."""
        recipe = super().recipe() | {"weights": self.weights_digest, "stride": self.stride_px}
        del recipe["revision"]
        recipe["hierarchy"] = self.hierarchy if self.binned else 0
        recipe["binned"] = sorted(set(self.binned))
        recipe["norm_last"] = self.norm_last and self.facet == "token"
        return recipe

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w) of one crop's map. Raises BadInput for a layer, stride or input size the model does not have."""
        _check(self, (layer,))
        cells, width = self.size_of(layer) // self.stride_px, self.sizes.width
        if layer in (CLASS_TOKEN_LAYER, CLASS_FACET_LAYER):
            return width, 1, 1
        if layer == SALIENCY_LAYER:
            return 1, cells, cells
        return width * (bin_count(self.hierarchy) if layer in self.binned else 1), cells, cells

    def load(self, runtime: Runtime) -> VitBackbone:
        """Weights into memory. Raises BadInput for weights that are missing or of another class."""
        _check(self, ())
        device = torch.device(runtime.torch_device())
        model = self.source.load_model(getattr(torch, self.dtype)).eval().requires_grad_(False).to(device)
        return VitBackbone(self, model, Passes.choose(_pass_footprint(self, device.type), runtime, device))

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint:
        """As Extractor.footprint; weights are counted from the headers of their files."""
        paths = [path for path in self.source.files.values() if path.suffix == ".safetensors"]
        values = sum(math.prod(shape) for path in paths for shape in tensor_shapes(path).values())
        maps = maps_bytes([self.feature_shape(layer) for layer in layers])
        passes = _pass_footprint(self, device)
        return replace(
            passes, weight_bytes=values * _bytes_per_value(self), bytes_per_crop=passes.bytes_per_crop + maps
        )


class VitBackbone:
    """A VitFeatures spec with its model in memory."""

    def __init__(self, spec: VitFeatures, model: nn.Module, passes: Passes) -> None:
        self.spec, self.model, self.passes = spec, model, passes

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers in the spec's dtype, on the model's device."""
        _check(self.spec, layers)
        with use_deterministic_convolutions():
            return self.passes.run(partial(self._run_pass, layers=layers), crops, layers)

    @torch.inference_mode()
    def _run_pass(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        sizes = {layer: self.spec.size_of(layer) for layer in layers}
        found: dict[int, Tensor] = {}
        for size in dict.fromkeys(sizes.values()):
            found |= self._read_layers(crops, [layer for layer in sizes if sizes[layer] == size], size=size)
        return {layer: found[layer] for layer in sizes}

    def _read_layers(self, crops: Crops, layers: Sequence[int], *, size: int) -> FeatureMaps:
        """Maps of layers that are read from one input of ``size`` pixels a side."""
        s = self.spec
        found = read_block_tokens(
            self.model,
            embed_patches(self.model, self._prepare_image(crops, size=size), stride=s.stride_px),
            layers=layers,
            facet=s.facet,
            norm_last=s.norm_last,
            saliency_heads=_heads(s),
            skipped=1 + s.sizes.registers,
        )
        return {layer: self._to_map(tokens, layer) for layer, tokens in found.items()}

    def _prepare_image(self, crops: Crops, *, size: int) -> Float[Tensor, "n 3 R R"]:
        """The image that patches are cut from: the crops at ``size``, padded and standardised."""
        s = self.spec
        rgb = torch.from_numpy(np.ascontiguousarray(crops.rgb)).to(self.passes.device)
        image = (to_network_image(rgb, size=size) + 1) / 2
        padded = pad_border(image, overhang=s.sizes.patch - s.stride_px)
        return standardise(padded).to(getattr(torch, s.dtype))

    def _to_map(self, tokens: Float[Tensor, "n t c"], layer: int) -> Float[Tensor, "n d h w"]:
        side = 1 if layer in (CLASS_TOKEN_LAYER, CLASS_FACET_LAYER) else self.spec.size_of(layer) // self.spec.stride_px
        maps = tokens.transpose(1, 2).unflatten(2, (side, side))
        return log_bin(maps, hierarchy=self.spec.hierarchy) if layer in self.spec.binned else maps


def _heads(spec: VitFeatures) -> Sequence[int]:
    return range(spec.sizes.heads) if spec.saliency_heads is None else spec.saliency_heads


def _check(spec: VitFeatures, layers: Sequence[int]) -> None:
    a, last = spec.sizes, spec.sizes.depth - 1
    for layer in layers:
        if not 0 <= layer <= last and layer not in (SALIENCY_LAYER, CLASS_TOKEN_LAYER, CLASS_FACET_LAYER):
            needed = f"0..{last}, the transformer's {a.depth} blocks, {PSEUDO_LAYERS}"
            raise BadInput("extract layer", found=layer, needed=needed)
    if CLASS_FACET_LAYER in layers and spec.facet == "token":
        needed = f"key, query or value, for layer {CLASS_FACET_LAYER} (match.class_token)"
        raise BadInput("extract.facet", found="token", needed=needed)
    if a.patch % spec.stride_px:
        divisors = ", ".join(str(n) for n in range(1, a.patch + 1) if a.patch % n == 0)
        raise BadInput("extract.stride", found=spec.stride, needed=f"a divisor of the patch size {a.patch}: {divisors}")
    for field, size in (("input_size", spec.input_size), ("local_size", spec.local_size or 0)):
        if size % spec.stride_px:
            raise BadInput(f"extract.{field}", found=size, needed=f"a multiple of the stride {spec.stride_px}")
    if unknown := [layer for layer in spec.binned if layer > last]:
        raise BadInput("extract.binned", found=unknown[0], needed=f"0..{last}, the transformer's {a.depth} blocks")
    if SALIENCY_LAYER in layers and (not _heads(spec) or max(_heads(spec)) >= a.heads):
        found, needed = list(_heads(spec)), f"some of 0..{a.heads - 1}, the {a.heads} heads of the last block"
        raise BadInput("extract.saliency_heads", found=found, needed=needed)


def _bytes_per_value(spec: VitFeatures) -> int:
    return 4 if spec.dtype == "float32" else 2


def _pass_footprint(spec: VitFeatures, device: str) -> Footprint:
    """Estimate of a pass from the maps in memory within a block and the widest map that is returned."""
    cells = (max(spec.input_size, spec.local_size or 0) // spec.stride_px) ** 2
    maps = _LIVE_MAPS + 2 * len(set(spec.binned)) * bin_count(spec.hierarchy)
    bytes_per_crop = maps * spec.sizes.width * cells * _bytes_per_value(spec)
    max_batch = _MOST_CROPS[device]
    return Footprint(0, 0, bytes_per_crop, max_batch, choose_cpu_pass(0, bytes_per_crop, max_batch))
