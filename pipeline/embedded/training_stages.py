"""Pictures -> autoencoder; latents -> denoiser; pairs of views -> descriptors: the three stages of the training."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from pipeline.backbones.stable_diffusion.configs import alphas_cumprod
from pipeline.backbones.stable_diffusion.features import to_network_image
from pipeline.embedded import losses
from pipeline.embedded.batches import CELLS, PairBatch, pair_batch, picture_batch
from pipeline.embedded.networks import (
    IMAGE_PX,
    DescriptorNetwork,
    LatentEncoder,
    build_unet,
    build_vae,
    mixed_precision,
    zero_prompt,
)
from pipeline.embedded.plan import TrainingFolder, TrainingPlan
from pipeline.functional.gradients import append_edges, edge_histograms

_EMA, _WARMUP_STEPS = 0.998, 50
_EDGE_WEIGHT = 1.5  # of gradient histograms relative to descriptors, as in conf/fuse/learned.yaml
_MAX_SCALE = 60.0


class TrainingStage(ABC):
    """One network, its moving average and its loss. Everything random depends only on the plan's seed and the step."""

    name: ClassVar[str]
    rate: ClassVar[float]
    decay: ClassVar[float] = 1e-2

    def __init__(self, plan: TrainingPlan, folder: TrainingFolder, steps: int, device: str = "cpu") -> None:
        self.plan, self.steps, self.source = plan, steps, folder.source(plan)
        self.device = torch.device(device)
        torch.manual_seed(plan.seed)
        self.model = self.build(folder).to(self.device, memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.model).requires_grad_(False)

    @abstractmethod
    def build(self, folder: TrainingFolder) -> Any:
        """The network with random weights, or with those of an earlier stage."""

    @abstractmethod
    def batch(self, step: int) -> Any:
        """The training batch of a step, on the CPU."""

    @abstractmethod
    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        """Loss terms by name; the loss is their sum."""

    def checkpoint_extras(self) -> dict[str, Any]:
        """What a checkpoint holds in addition to the weights."""
        return {}

    def rate_at(self, step: int) -> float:
        """Learning rate: linear warm-up, then cosine decay to 2 % of the maximum."""
        progress = min(step / self.steps, 1.0)
        warmup = min((step + 1) / _WARMUP_STEPS, 1.0)
        return self.rate * warmup * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * progress)))

    def update_average(self, step: int) -> None:
        """Update the exponential moving average; it follows faster in the first steps."""
        update = get_ema_multi_avg_fn(min(_EMA, (1 + step) / (10 + step)))
        update(list(self.average.parameters()), list(self.model.parameters()), step)


class Autoencoder(TrainingStage):
    """AutoencoderKL with latent cells of 4 px."""

    name, rate = "autoencoder", 2e-3

    def build(self, folder: TrainingFolder) -> Any:
        """Random weights."""
        return build_vae()

    def batch(self, step: int) -> Tensor:
        """Pictures."""
        return picture_batch(self.source, step, count=self.plan.pictures)

    def loss(self, batch: Tensor, step: int) -> dict[str, Tensor]:
        """Reconstruction loss."""
        image = to_network_image(batch.to(self.device), size=IMAGE_PX)
        with mixed_precision(self.device):
            posterior = self.model.encode(image).latent_dist
            generator = torch.Generator().manual_seed(step)
            decoded = self.model.decode(posterior.sample(generator)).sample
        mean, logvar = posterior.mean.float(), posterior.logvar.float()
        return {"loss": losses.reconstruction_loss(decoded.float(), image, mean, logvar)}

    @torch.no_grad()
    def checkpoint_extras(self) -> dict[str, Any]:
        """The scaling factor: 1 / standard deviation of latents (Rombach et al., CVPR 2022, App. G)."""
        image = to_network_image(picture_batch(self.source, 0, count=32).to(self.device), size=IMAGE_PX)
        return {"scaling_factor": round(1 / float(self.average.encode(image).latent_dist.mean.std()), 4)}


class Denoiser(TrainingStage):
    """UNet2DConditionModel that predicts the noise, as Stable Diffusion 1.x does."""

    name, rate = "denoiser", 1.5e-3

    def build(self, folder: TrainingFolder) -> Any:
        """Random weights; latents come from the trained autoencoder."""
        self.encode = LatentEncoder(folder, self.device)
        self.alphas = torch.from_numpy(alphas_cumprod({})).float().to(self.device)
        return build_unet()

    def batch(self, step: int) -> Tensor:
        """Pictures."""
        return picture_batch(self.source, step, count=self.plan.pictures)

    def loss(self, batch: Tensor, step: int) -> dict[str, Tensor]:
        """Squared error of the noise at random timesteps (Ho et al., NeurIPS 2020, Eq. 14)."""
        latent = self.encode(batch.to(self.device)).repeat(self.plan.noises, 1, 1, 1)
        generator = torch.Generator().manual_seed(step)
        noise = torch.randn(latent.shape, generator=generator).to(self.device)
        timestep = torch.randint(len(self.alphas), (len(latent),), generator=generator).to(self.device)
        alpha = self.alphas[timestep][:, None, None, None]
        with mixed_precision(self.device):
            noisy = alpha.sqrt() * latent + (1 - alpha).sqrt() * noise
            predicted = self.model(noisy, timestep, zero_prompt(len(latent), self.device)).sample
        return {"loss": (predicted.float() - noise).square().mean()}


class Descriptors(TrainingStage):
    """The denoiser and a head over its maps, trained together on correspondences and retrieval."""

    name, rate = "descriptors", 1.5e-3

    def build(self, folder: TrainingFolder) -> Any:
        """The trained denoiser, with a head of random weights."""
        self.encode = LatentEncoder(folder, self.device)
        unet = build_unet()
        unet.load_state_dict(folder.load_checkpoint("denoiser", self.device)["average"])
        return DescriptorNetwork(unet)

    def batch(self, step: int) -> PairBatch:
        """Clusters of views of some objects."""
        return pair_batch(self.source, step, count=self.plan.objects, hard=step >= self.plan.easy)

    def loss(self, batch: PairBatch, step: int) -> dict[str, Tensor]:
        """Correspondence loss of descriptors, with and without edges appended, and retrieval loss."""
        batch = batch.to(self.device)
        return descriptor_losses(self.model, self.encode(batch.rgb), batch)


def descriptor_losses(model: DescriptorNetwork, latent: Tensor, batch: PairBatch) -> dict[str, Tensor]:
    """Correspondence and retrieval losses of a batch."""
    descriptors, coarse = model(latent)
    scale = model.log_scale.clamp(max=math.log(_MAX_SCALE)).exp()
    edges = edge_histograms(batch.rgb, batch.mask, cells=CELLS)
    with_edges = append_edges(descriptors, edges, weight=_EDGE_WEIGHT)
    scores = losses.retrieval_scores(coarse, batch)
    return {
        "correspondence": losses.correspondence_loss(descriptors, batch, scale[0]),
        "with_edges": losses.correspondence_loss(with_edges, batch, scale[2]),
        "retrieval": losses.retrieval_loss(scores, batch.angle_deg, scale[1]),
    }
