"""crops -> feature maps of two extractors, concatenated (Zhang et al., NeurIPS 2023: A Tale of Two Features)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import field
from functools import partial
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, Field, PlainValidator

from pipeline.backbones.batching import Footprint, Passes, maps_bytes
from pipeline.backbones.extractor import Backbone, Extractor
from pipeline.errors import BadInput
from pipeline.functional.maps import concatenate_normalized
from pipeline.items.features import FeatureMaps
from pipeline.items.views import Crops
from pipeline.spec import Fraction, Runtime, spec
from pipeline.stages.extract.dinov2 import DinoV2
from pipeline.stages.extract.stable_diffusion import StableDiffusion


def _check_extractor(value: Any) -> Any:
    if not isinstance(value, Extractor):
        raise ValueError("an extract variant, chosen as extract@extract.first=hog")
    return value


def _check_unique(pairs: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
    if len(dict(pairs)) < len(pairs):
        raise ValueError("each layer of the first extractor once")
    return pairs


Member = Annotated[Extractor, PlainValidator(_check_extractor)]
LayerPairs = Annotated[tuple[tuple[int, int], ...], Field(min_length=1), AfterValidator(_check_unique)]


@spec
class Fusion(Extractor):
    """Any two extractors; layer l concatenates layer l of the first with its partner layer of the second.

    ``layers``: the pairs of layers. The second's map is resampled to the cells of the first; both descriptors of a cell
    are scaled to unit length and multiplied by ``alpha`` and 1 - ``alpha``. The cosine of two fused cells is then the
    mean of both cosines, weighted by the squares of these factors.
    """

    kind: ClassVar[str] = "extract.fusion"
    version: ClassVar[int] = 1

    first: Member = field(default_factory=StableDiffusion)
    second: Member = field(default_factory=DinoV2)
    layers: LayerPairs = ((2, 18), (5, 18), (8, 18), (11, 18))
    alpha: Fraction = 0.5

    @property
    def needs_geometry(self) -> bool:
        """Whether either is an oracle."""
        return self.first.needs_geometry or self.second.needs_geometry

    @property
    def notice(self) -> str:
        """The notices of both, each once."""
        return "\n".join(dict.fromkeys(filter(None, [self.first.notice, self.second.notice])))

    @property
    def model(self) -> str:
        """Names of both models."""
        with _name_member("first"):
            first = self.first.model
        with _name_member("second"):
            return f"fusion-{first}-{self.second.model}"

    @property
    def timestep(self) -> int:
        """Timestep of the first, or of the second where the first has none."""
        return self.first.timestep or self.second.timestep

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the recipes of both extractors."""
        with _name_member("first"):
            first = self.first.recipe()
        with _name_member("second"):
            second = self.second.recipe()
        layers = sorted(list(pair) for pair in self.layers)
        return {
            "kind": self.kind,
            "version": self.version,
            "first": first,
            "second": second,
            "layers": layers,
            "alpha": self.alpha,
        }

    def feature_shape(self, layer: int) -> tuple[int, int, int]:
        """(c, h, w). Raises BadInput for a layer without a pair, or that an extractor does not have."""
        other = self.partner(layer)
        with _name_member("first"):
            channels, h, w = self.first.feature_shape(layer)
        try:
            with _name_member("second"):
                return channels + self.second.feature_shape(other)[0], h, w
        except BadInput as error:
            if not error.where.endswith(" layer"):
                raise
            found = f"layer {other} of the second extractor, paired with layer {layer}"
            raise BadInput("extract.layers", found=found, needed=error.needed) from None

    def partner(self, layer: int) -> int:
        """The second extractor's layer that is paired with ``layer``. Raises BadInput where there is none."""
        pairs = dict(self.layers)
        if layer not in pairs:
            needed = f"one of {', '.join(map(str, sorted(pairs)))}, as extract.layers pairs them"
            raise BadInput("extract layer", found=layer, needed=needed)
        return pairs[layer]

    def footprint(self, layers: Sequence[int], crop_size: int, device: str = "cpu") -> Footprint | None:
        """As Extractor.footprint: both models in memory, the larger pass of the two, and the maps of both.

        None where either is unknown.
        """
        first = self.first.footprint(layers, crop_size, device)
        second = self.second.footprint([self.partner(k) for k in layers], crop_size, device)
        if first is None or second is None:
            return None
        maps = maps_bytes([self.feature_shape(layer) for layer in layers])
        return Footprint(
            weight_bytes=first.weight_bytes + second.weight_bytes,
            bytes_per_pass=max(first.bytes_per_pass, second.bytes_per_pass),
            bytes_per_crop=max(first.bytes_per_crop, second.bytes_per_crop) + maps,
            max_batch=min(first.max_batch, second.max_batch),
            cpu_pass=min(first.cpu_pass, second.cpu_pass),
        )

    def load(self, runtime: Runtime) -> FusionBackbone:
        """Weights of both into memory. Raises BadInput for weights that are missing or of another class."""
        with _name_member("first"):
            first = self.first.load(runtime)
        with _name_member("second"):
            second = self.second.load(runtime)
        return FusionBackbone(self, first, second)


class FusionBackbone:
    """A Fusion spec with both extractors in memory."""

    def __init__(self, spec: Fusion, first: Backbone, second: Backbone) -> None:
        self.spec, self.first, self.second = spec, first, second
        size = min(first.passes.size, second.passes.size)
        batch = min(first.passes.batch, second.passes.batch)
        self.passes = Passes(first.passes.device, max(1, batch // size) * size, size)

    def __call__(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        """Maps of the given layers, float32."""
        for layer in layers:
            self.spec.feature_shape(layer)
        return self.passes.run(partial(self._run_pass, layers=layers), crops, layers)

    def _run_pass(self, crops: Crops, layers: Sequence[int]) -> FeatureMaps:
        partner = {layer: self.spec.partner(layer) for layer in layers}
        first = self.first(crops, tuple(partner))
        second = self.second(crops, tuple(sorted(set(partner.values()))))
        return {
            k: concatenate_normalized(first[k], second[other], alpha=self.spec.alpha) for k, other in partner.items()
        }


@contextmanager
def _name_member(member: str) -> Iterator[None]:
    """Name the member in errors about its fields: extract.weights becomes extract.first.weights."""
    try:
        yield
    except BadInput as error:
        if not error.where.startswith("extract"):
            raise
        where = f"extract.{member}{error.where.removeprefix('extract')}"
        raise BadInput(where, found=error.found, needed=error.needed) from None
