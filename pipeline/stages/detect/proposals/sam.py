"""image -> masks of possible objects (Kirillov et al., ICCV 2023, "Segment Anything")."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, UInt8
from PIL import Image as Picture
from pydantic import Field
from torch import Tensor

from pipeline.backbones.sam import SamWeights, open_sam_weights
from pipeline.bop.masks import encode_rle
from pipeline.functional.boxes import area, non_maximum_suppression
from pipeline.functional.camera import mask_bbox
from pipeline.io.checkpoints import tensor_shapes
from pipeline.io.digests import files_digest
from pipeline.items.views import Image, Proposal
from pipeline.spec import Fraction, Positive, PositiveFloat, Runtime, spec
from pipeline.stages.detect.proposals import Proposer

POINTS_PER_BATCH = 64
_MEAN, _STD = np.array([[0.485, 0.456, 0.406], [0.229, 0.224, 0.225]], np.float32)  # of ImageNet
_BLOCK = 1 << 26  # logits upsampled at a time


@spec
class Sam(Proposer):
    """Masks of SAM or SAM 2 for a grid of points, filtered by confidence and stability, without near duplicates.

    ``weights``: a hub id (with an optional ``revision``) or a folder that save_pretrained wrote, of a SamModel or
    Sam2Model; the recipe holds the digest of the files instead of these two fields.

    ``min_iou``: minimum of the IoU that the model predicts for its mask. ``min_stability``: minimum IoU of the masks
    thresholded at +- ``stability_offset``. ``nms_iou``: of two boxes with a larger IoU, the mask with the lower
    predicted IoU is dropped. ``min_box_size``: minimum of sqrt(box area / image area); ``min_mask_size``: minimum of
    mask area / image area; both as in CNOS.

    Differences to CNOS: the image is not resized to a width of 640 first, and boxes extend to the pixels' edges.
    """

    kind: ClassVar[str] = "proposals.sam"
    version: ClassVar[int] = 1

    weights: str = "facebook/sam-vit-huge"
    revision: str | None = None
    points_per_side: Positive = 32
    min_iou: Fraction = 0.88
    min_stability: Fraction = 0.97
    stability_offset: PositiveFloat = 1.0
    nms_iou: Fraction = 0.7
    min_box_size: Annotated[float, Field(ge=0, lt=1)] = 0.05
    min_mask_size: Annotated[float, Field(ge=0, lt=1)] = 3e-4

    @cached_property
    def source(self) -> SamWeights:
        """Where the weights are; a hub id is downloaded first. Raises BadInput."""
        return open_sam_weights(self.weights, self.revision)

    @cached_property
    def weights_digest(self) -> str:
        """sha256 of all files that the proposals depend on. Raises BadInput."""
        return files_digest(self.source.files)

    def recipe(self) -> dict[str, Any]:
        """As Spec.recipe, with the weights' digest instead of their location."""
        recipe = super().recipe() | {"weights": self.weights_digest}
        del recipe["revision"]
        return recipe

    def weight_bytes(self) -> int:
        """Memory that the float32 weights take."""
        return 4 * sum(math.prod(shape) for path in self.source.tensors for shape in tensor_shapes(path).values())

    def load(self, runtime: Runtime) -> LoadedSam:
        """See Proposer."""
        return LoadedSam(self, self.source.load_model().to(runtime.torch_device()).eval(), runtime.batch)


class LoadedSam:
    """SAM or SAM 2 in memory.

    ``batch``: points per pass of the mask decoder on a GPU, 0 for the usual 64; always 64 on the CPU, so that no byte
    depends on it.
    """

    def __init__(self, spec: Sam, model: Any, batch: int = 0) -> None:
        self.spec, self.model = spec, model
        self.batch = POINTS_PER_BATCH if model.device.type == "cpu" else batch or POINTS_PER_BATCH
        self.side = int(model.config.prompt_encoder_config.image_size)
        self.resizes_to_square = model.config.model_type != "sam"  # SAM 2; SAM pads instead

    @torch.inference_mode()
    def __call__(self, image: Image) -> list[Proposal]:
        """See LoadedProposer."""
        size_hw = (image.rgb.shape[0], image.rgb.shape[1])
        found = [
            Proposal(box, encode_rle(mask), confidence)
            for logits, iou in self._decode(image.rgb)
            for mask, confidence in self._filter(logits, iou, size_hw)
            if (box := mask_bbox(mask)) is not None and mask.mean() > self.spec.min_mask_size
        ]
        boxes = np.array([p.bbox_xyxy for p in found]).reshape(-1, 4)
        score = np.array([p.confidence for p in found])
        kept = non_maximum_suppression(boxes, score, max_iou=self.spec.nms_iou)
        kept &= area(boxes) > self.spec.min_box_size**2 * size_hw[0] * size_hw[1]
        return [found[i] for i in np.argsort(-score, kind="stable") if kept[i]]

    def _decode(self, rgb: UInt8[np.ndarray, "H W 3"]) -> Iterator[tuple[Float[Tensor, "m s s"], Float[Tensor, " m"]]]:
        """Logits and predicted IoU of three masks for each point of the grid, one batch of points at a time."""
        used_hw = self.used_hw((rgb.shape[0], rgb.shape[1]))
        embeddings = self.model.get_image_embeddings(self.prepare(rgb).to(self.model.device))
        for points in make_grid(self.spec.points_per_side, used_hw).split(self.batch):
            prompts = points[None, :, None].to(self.model.device)
            output = self.model(image_embeddings=embeddings, input_points=prompts, multimask_output=True)
            yield output.pred_masks[0].flatten(0, 1), output.iou_scores[0].flatten()

    def _filter(
        self, logits: Float[Tensor, "m s s"], iou: Float[Tensor, " m"], size_hw: tuple[int, int]
    ) -> Iterator[tuple[Bool[np.ndarray, "H W"], float]]:
        """Masks at the image's size that pass both thresholds, with their predicted IoU."""
        chosen = iou > self.spec.min_iou
        if not chosen.any():
            return
        block = max(1, _BLOCK // max(self.side**2, size_hw[0] * size_hw[1]))
        for small, confidence in zip(logits[chosen].split(block), iou[chosen].split(block), strict=True):
            large = self.upsample(small, size_hw)
            stable = compute_stability(large, offset=self.spec.stability_offset) > self.spec.min_stability
            masks = (large[stable] > 0).cpu().numpy()
            yield from zip(masks, confidence[stable].tolist(), strict=True)

    def used_hw(self, size_hw: tuple[int, int]) -> tuple[int, int]:
        """Height and width of an image within the model's square input."""
        if self.resizes_to_square:
            return self.side, self.side
        scale = self.side / max(size_hw)
        return int(size_hw[0] * scale + 0.5), int(size_hw[1] * scale + 0.5)

    def prepare(self, rgb: UInt8[np.ndarray, "H W 3"]) -> Float[Tensor, "1 3 side side"]:
        """The model's input: resized, normalised, and for SAM padded with zeros on the right or below."""
        h, w = self.used_hw((rgb.shape[0], rgb.shape[1]))
        resized = np.asarray(Picture.fromarray(rgb).resize((w, h), Picture.Resampling.BILINEAR), np.float32) / 255
        normal = torch.from_numpy((resized - _MEAN) / _STD).movedim(-1, 0)
        return F.pad(normal, (0, self.side - w, 0, self.side - h))[None]

    def upsample(self, logits: Float[Tensor, "m s s"], size_hw: tuple[int, int]) -> Float[Tensor, "m H W"]:
        """Logits resampled from the model's square input to the image's pixels."""
        large = logits[None]
        if not self.resizes_to_square:
            h, w = self.used_hw(size_hw)
            large = F.interpolate(large, (self.side, self.side), mode="bilinear", align_corners=False)[..., :h, :w]
        return F.interpolate(large, size_hw, mode="bilinear", align_corners=False)[0]


def make_grid(per_side: int, used_hw: tuple[int, int]) -> Float[Tensor, "m 2"]:
    """Centres (x, y) of ``per_side`` x ``per_side`` equal cells in row-major order, px from the input's edge."""
    centres = (torch.arange(per_side, dtype=torch.float64) + 0.5) / per_side
    y, x = torch.meshgrid(centres * used_hw[0], centres * used_hw[1], indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], dim=1).float()


def compute_stability(logits: Float[Tensor, "m H W"], *, offset: float) -> Float[Tensor, " m"]:
    """IoU of the masks thresholded at +``offset`` and -``offset``; 0 where both are empty."""
    inner, outer = ((logits > bound).sum((1, 2)) for bound in (offset, -offset))
    return inner / outer.clamp(min=1)
