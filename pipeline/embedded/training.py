"""pictures -> autoencoder; latents -> denoiser; pairs of views -> descriptors. Seeded, resumable, each a Stage."""

from __future__ import annotations

import copy
import json
import math
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pipeline.embedded import losses
from pipeline.embedded.batches import Source, pair_batch, picture_batch
from pipeline.functional.aggregation import Aggregation
from pipeline.stages.extract.decoder import decoder_maps, map_shape
from pipeline.stages.extract.diffusion import clean_latent, network_image
from pipeline.stages.extract.embedded import PROMPT, untrained
from pipeline.stages.extract.weights import alphas_cumprod

LAYERS, MATCH_LAYER, DIM, TIMESTEP = (2, 5, 8, 11), 8, 64, 50
UNET: dict[str, Any] = {
    "sample_size": 32,
    "in_channels": 8,
    "out_channels": 8,
    "block_out_channels": (32, 64, 96, 96),
    "layers_per_block": 2,
    "cross_attention_dim": PROMPT[-1],
    "attention_head_dim": (1, 2, 3, 3),
    "norm_num_groups": 8,
    "down_block_types": ("DownBlock2D", "DownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D", "UpBlock2D"),
}
VAE: dict[str, Any] = {
    "block_out_channels": (16, 32, 32),
    "layers_per_block": 1,
    "norm_num_groups": 8,
    "latent_channels": 8,
    "scaling_factor": 1.0,
    "down_block_types": ("DownEncoderBlock2D",) * 3,
    "up_block_types": ("UpDecoderBlock2D",) * 3,
}
_EMA, _WARMUP = 0.998, 50


@dataclass(frozen=True)
class Plan:
    """How many steps each stage takes, and what of; the first ``easy`` of the descriptors are on easier pictures."""

    shards: int = 150
    autoencoder: int = 500
    denoiser: int = 400
    descriptors: int = 5300
    easy: int = 2700
    seed: int = 0


@dataclass(frozen=True)
class Place:
    """Folder of a training: shards, checkpoints, loss curves."""

    folder: Path

    def source(self, plan: Plan, *, validation: bool = False) -> Source:
        """Its shards."""
        if validation:
            return Source(self.folder / "shards", 2, seed=1, start=2, validation=True)
        return Source(self.folder / "shards", plan.shards, seed=plan.seed)

    def checkpoint(self, stage: str) -> Path:
        """The last checkpoint of a stage."""
        return self.folder / f"{stage}.pt"

    def curve(self, stage: str) -> Path:
        """Its losses, a line of JSON each."""
        return self.folder / f"{stage}.jsonl"


class Stage(ABC):
    """One network with its optimiser. ``loss(step)`` draws its own batch; everything random depends on the step."""

    name: str
    rate: float
    decay = 1e-2

    def __init__(self, plan: Plan, place: Place, steps: int) -> None:
        self.plan, self.steps, self.source = plan, steps, place.source(plan)
        torch.manual_seed(plan.seed)
        self.model = self.build(place).to(memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.model).requires_grad_(False)

    @abstractmethod
    def build(self, place: Place) -> Any:
        """The network, freshly initialised or as an earlier stage left it."""

    @abstractmethod
    def loss(self, step: int) -> dict[str, Tensor]:
        """Terms to be added up."""

    def rate_at(self, step: int) -> float:
        """Linear warm-up, then a cosine to a fiftieth."""
        progress = min(step / self.steps, 1.0)
        return self.rate * min((step + 1) / _WARMUP, 1.0) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * progress)))

    def follow(self, step: int) -> None:
        """Move the average towards the model; slowly, once there is something to remember."""
        keep = min(_EMA, (1 + step) / (10 + step))
        with torch.no_grad():
            for slow, fast in zip(self.average.state_dict().values(), self.model.state_dict().values(), strict=True):
                slow.lerp_(fast, 1 - keep) if slow.is_floating_point() else slow.copy_(fast)


class Autoencoder(Stage):
    """AutoencoderKL, 4 pixels to a cell."""

    name, rate = "autoencoder", 2e-3

    def build(self, place: Place) -> Any:
        """From nothing."""
        return untrained(UNET, VAE)[1]

    def loss(self, step: int) -> dict[str, Tensor]:
        """Reconstruction of 16 pictures."""
        image = network_image(picture_batch(self.source, step, count=16), size=128)
        with _mixed():
            posterior = self.model.encode(image).latent_dist
            generator = torch.Generator().manual_seed(step)
            made = self.model.decode(posterior.sample(generator)).sample
        return {
            "loss": losses.reconstruction_loss(made.float(), image, posterior.mean.float(), posterior.logvar.float())
        }


class Denoiser(Stage):
    """UNet2DConditionModel; predicts the noise, as Stable Diffusion 1.x does."""

    name, rate = "denoiser", 1.5e-3

    def build(self, place: Place) -> Any:
        """From nothing, on the latents of the autoencoder."""
        self.encode = Latents(place)
        self.alphas = torch.from_numpy(alphas_cumprod({})).float()
        return untrained(UNET, VAE)[0]

    def loss(self, step: int) -> dict[str, Tensor]:
        """Squared error of the noise of 32 pictures at any timesteps (Ho et al., NeurIPS 2020, Eq. 14)."""
        latent = self.encode(picture_batch(self.source, step, count=32))
        generator = torch.Generator().manual_seed(step)
        noise = torch.randn(latent.shape, generator=generator)
        timestep = torch.randint(len(self.alphas), (len(latent),), generator=generator)
        kept = self.alphas[timestep][:, None, None, None]
        with _mixed():
            made = self.model(kept.sqrt() * latent + (1 - kept).sqrt() * noise, timestep, prompt(len(latent))).sample
        return {"loss": (made.float() - noise).square().mean()}


class Descriptors(Stage):
    """The denoiser and an aggregation of its maps, together, on correspondences and retrieval."""

    name, rate = "descriptors", 1.5e-3

    def build(self, place: Place) -> Any:
        """On from the denoiser's average."""
        self.encode = Latents(place)
        unet = untrained(UNET, VAE)[0]
        unet.load_state_dict(torch.load(place.checkpoint("denoiser"), weights_only=True)["average"])
        return Described(unet)

    def loss(self, step: int) -> dict[str, Tensor]:
        """Both losses of 2 objects' 2 clusters of 8 pictures."""
        batch = pair_batch(self.source, step, count=2, hard=step >= self.plan.easy)
        return described_losses(self.model, self.encode(batch.rgb), batch)


class Described(nn.Module):
    """A U-Net, the head over its maps, and the sharpness of both comparisons."""

    def __init__(self, unet: nn.Module) -> None:
        super().__init__()
        self.unet = unet
        self.head = Aggregation({k: map_shape(UNET, layer=k, hook="pre", latent_size=32)[0] for k in LAYERS}, DIM)
        self.log_scale = nn.Parameter(torch.tensor([math.log(15.0), math.log(20.0)]))

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors, and the maps that templates are chosen by."""
        with _mixed():
            maps = decoder_maps(self.unet, latent, TIMESTEP, prompt(1), layers=LAYERS, hook="pre")
            maps = {k: m.float() for k, m in maps.items()}
            return self.head(maps), maps[MATCH_LAYER]


def described_losses(model: Described, latent: Tensor, batch: Any) -> dict[str, Tensor]:
    """Correspondence and retrieval loss of a batch."""
    descriptors, coarse = model(latent)
    scale = model.log_scale.clamp(max=math.log(60.0)).exp()
    scores = losses.retrieval_scores(coarse, batch)
    return {
        "correspondence": losses.correspondence_loss(descriptors, batch, scale[0]),
        "retrieval": losses.retrieval_loss(scores, batch.angle_deg, scale[1]),
    }


class Latents:
    """Pictures -> latents of unit variance, by the autoencoder as trained so far."""

    def __init__(self, place: Place) -> None:
        saved = torch.load(place.checkpoint("autoencoder"), weights_only=True)
        self.vae = untrained(UNET, VAE)[1].to(memory_format=torch.channels_last)
        self.vae.load_state_dict(saved["average"])
        self.vae.eval().requires_grad_(False)
        self.config = VAE | {"scaling_factor": saved["scaling_factor"]}

    @torch.no_grad()
    def __call__(self, rgb: Tensor) -> Tensor:
        """Clean latents."""
        with _mixed():
            latent = clean_latent(self.vae, self.config, network_image(rgb, size=128))
        return latent.float().contiguous(memory_format=torch.channels_last)


def prompt(count: int) -> Tensor:
    """The text that the model does not know."""
    return torch.zeros(PROMPT).expand(count, -1, -1)


def train(stage: Stage, place: Place, *, until: float, save_every_s: float = 90.0) -> bool:
    """Run a stage to its end or to the time ``until``, from its last checkpoint on. Returns whether it ended."""
    optimiser = torch.optim.AdamW(stage.model.parameters(), lr=stage.rate, weight_decay=stage.decay, betas=(0.9, 0.98))
    step = _resumed(stage, optimiser, place)
    saved_at = time.monotonic()
    while step < stage.steps and time.time() < until:
        started = time.monotonic()
        for group in optimiser.param_groups:
            group["lr"] = stage.rate_at(step)
        terms = stage.loss(step)
        optimiser.zero_grad()
        sum(terms.values(), torch.zeros(())).backward()
        norm = nn.utils.clip_grad_norm_(stage.model.parameters(), 1.0)
        optimiser.step()
        stage.follow(step)
        record = {name: round(float(value.detach()), 5) for name, value in terms.items()} | {
            "norm": round(float(norm), 3)
        }
        _note(place, stage, {"step": step, **record, "time_s": round(time.monotonic() - started, 3)})
        step += 1
        if time.monotonic() - saved_at > save_every_s:
            _save(stage, optimiser, step, place)
            saved_at = time.monotonic()
    _save(stage, optimiser, step, place)
    return step >= stage.steps


def _note(place: Place, stage: Stage, record: dict[str, float]) -> None:
    with place.curve(stage.name).open("a") as curve:
        curve.write(json.dumps(record) + "\n")


def _resumed(stage: Stage, optimiser: torch.optim.Optimizer, place: Place) -> int:
    path = place.checkpoint(stage.name)
    if not path.exists():
        return 0
    saved = torch.load(path, weights_only=True)
    stage.model.load_state_dict(saved["model"])
    stage.average.load_state_dict(saved["average"])
    optimiser.load_state_dict(saved["optimiser"])
    return int(saved["step"])


def _save(stage: Stage, optimiser: torch.optim.Optimizer, step: int, place: Place) -> None:
    """Write a checkpoint beside the last one, then put it in its place."""
    state: dict[str, Any] = {"step": step, "model": stage.model.state_dict(), "average": stage.average.state_dict()}
    state["optimiser"] = optimiser.state_dict()
    if isinstance(stage, Autoencoder):
        state["scaling_factor"] = _scaling(stage)
    partial = place.checkpoint(stage.name).with_suffix(".partial")
    torch.save(state, partial)
    partial.rename(place.checkpoint(stage.name))


@torch.no_grad()
def _scaling(stage: Autoencoder) -> float:
    """One over the standard deviation of latents (Rombach et al., CVPR 2022, App. G)."""
    image = network_image(picture_batch(stage.source, 0, count=32), size=128)
    return round(1 / float(stage.average.encode(image).latent_dist.mean.std()), 4)


def _mixed() -> torch.autocast:
    return torch.autocast("cpu", dtype=torch.bfloat16)
