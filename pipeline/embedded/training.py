"""pictures -> autoencoder; latents -> denoiser; pairs of views -> descriptors. Seeded, resumable, each a Stage."""

from __future__ import annotations

import copy
import json
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import cv2
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn
from torch.utils.data import DataLoader, Dataset

from pipeline.backbones.stable_diffusion.configs import alphas_cumprod
from pipeline.backbones.stable_diffusion.decoder import map_shape, read_decoder_maps
from pipeline.backbones.stable_diffusion.features import encode_latent, to_network_image
from pipeline.backbones.stable_diffusion.loading import build_untrained
from pipeline.embedded import losses
from pipeline.embedded.batches import CELLS, PairBatch, Source, pair_batch, picture_batch
from pipeline.functional.aggregation import Aggregation
from pipeline.functional.gradients import append_edges, edge_histograms
from pipeline.stages.extract.embedded import PROMPT

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
_EDGES = 1.5  # weight of gradient histograms beside descriptors, as in conf/fuse/learned.yaml
_NOTED = 25  # steps between two waits for the device


@dataclass(frozen=True)
class Plan:
    """How many steps each stage takes, and what of; the first ``easy`` of the descriptors are on easier pictures.

    A batch has ``pictures``, each with ``noises`` of them, or ``objects`` with all their clusters of views.
    """

    shards: int = 300
    autoencoder: int = 1200
    denoiser: int = 1500
    descriptors: int = 5600
    easy: int = 800
    pictures: int = 64
    noises: int = 4
    objects: int = 8
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
    """One network with its optimiser. ``batch(step)`` draws on the CPU; everything random depends on the step."""

    name: ClassVar[str]
    rate: ClassVar[float]
    decay: ClassVar[float] = 1e-2

    def __init__(self, plan: Plan, place: Place, steps: int, device: str = "cpu") -> None:
        self.plan, self.steps, self.source = plan, steps, place.source(plan)
        self.device = torch.device(device)
        torch.manual_seed(plan.seed)
        self.model = self.build(place).to(self.device, memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.model).requires_grad_(False)

    @abstractmethod
    def build(self, place: Place) -> Any:
        """The network, freshly initialised or as an earlier stage left it."""

    @abstractmethod
    def batch(self, step: int) -> Any:
        """What a step learns from, on the CPU."""

    @abstractmethod
    def loss(self, batch: Any, step: int) -> dict[str, Tensor]:
        """Terms to be added up."""

    def rate_at(self, step: int) -> float:
        """Linear warm-up, then a cosine to a fiftieth."""
        progress = min(step / self.steps, 1.0)
        return self.rate * min((step + 1) / _WARMUP, 1.0) * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * progress)))

    def follow(self, step: int) -> None:
        """Move the average towards the model; slowly, once there is something to remember."""
        follow = get_ema_multi_avg_fn(min(_EMA, (1 + step) / (10 + step)))
        follow(list(self.average.parameters()), list(self.model.parameters()), step)


class Autoencoder(Stage):
    """AutoencoderKL, 4 pixels to a cell."""

    name, rate = "autoencoder", 2e-3

    def build(self, place: Place) -> Any:
        """From nothing."""
        return build_untrained(UNET, VAE)[1]

    def batch(self, step: int) -> Tensor:
        """Pictures."""
        return picture_batch(self.source, step, count=self.plan.pictures)

    def loss(self, batch: Tensor, step: int) -> dict[str, Tensor]:
        """Reconstruction."""
        image = to_network_image(batch.to(self.device), size=128)
        with _mixed(self.device):
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
        self.encode = Latents(place, self.device)
        self.alphas = torch.from_numpy(alphas_cumprod({})).float().to(self.device)
        return build_untrained(UNET, VAE)[0]

    def batch(self, step: int) -> Tensor:
        """Pictures."""
        return picture_batch(self.source, step, count=self.plan.pictures)

    def loss(self, batch: Tensor, step: int) -> dict[str, Tensor]:
        """Squared error of the noise at any timesteps (Ho et al., NeurIPS 2020, Eq. 14)."""
        latent = self.encode(batch.to(self.device)).repeat(self.plan.noises, 1, 1, 1)
        generator = torch.Generator().manual_seed(step)
        noise = torch.randn(latent.shape, generator=generator).to(self.device)
        timestep = torch.randint(len(self.alphas), (len(latent),), generator=generator).to(self.device)
        kept = self.alphas[timestep][:, None, None, None]
        with _mixed(self.device):
            noisy = kept.sqrt() * latent + (1 - kept).sqrt() * noise
            made = self.model(noisy, timestep, prompt(len(latent), self.device)).sample
        return {"loss": (made.float() - noise).square().mean()}


class Descriptors(Stage):
    """The denoiser and an aggregation of its maps, together, on correspondences and retrieval."""

    name, rate = "descriptors", 1.5e-3

    def build(self, place: Place) -> Any:
        """On from the denoiser's average."""
        self.encode = Latents(place, self.device)
        unet = build_untrained(UNET, VAE)[0]
        unet.load_state_dict(_loaded(place.checkpoint("denoiser"), self.device)["average"])
        return Described(unet)

    def batch(self, step: int) -> PairBatch:
        """Objects' clusters."""
        return pair_batch(self.source, step, count=self.plan.objects, hard=step >= self.plan.easy)

    def loss(self, batch: PairBatch, step: int) -> dict[str, Tensor]:
        """Correspondences of descriptors, alone and with edges beside them, and retrieval."""
        batch = batch.on(self.device)
        return described_losses(self.model, self.encode(batch.rgb), batch)


class Described(nn.Module):
    """A U-Net, the head over its maps, and the sharpness of the comparisons."""

    def __init__(self, unet: nn.Module) -> None:
        super().__init__()
        self.unet = unet
        self.head = Aggregation({k: map_shape(UNET, layer=k, hook="pre", latent_size=32)[0] for k in LAYERS}, DIM)
        self.log_scale = nn.Parameter(torch.tensor([15.0, 20.0, 20.0]).log())

    def forward(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors, and the maps that templates are chosen by."""
        with _mixed(latent.device):
            known = prompt(1, latent.device)
            maps = read_decoder_maps(self.unet, latent, TIMESTEP, known, layers=LAYERS, hook="pre")
            maps = {k: m.float() for k, m in maps.items()}
            return self.head(maps), maps[MATCH_LAYER]


def described_losses(model: Described, latent: Tensor, batch: PairBatch) -> dict[str, Tensor]:
    """Correspondence and retrieval losses of a batch."""
    descriptors, coarse = model(latent)
    scale = model.log_scale.clamp(max=math.log(60.0)).exp()
    whole = append_edges(descriptors, edge_histograms(batch.rgb, batch.mask, cells=CELLS), weight=_EDGES)
    scores = losses.retrieval_scores(coarse, batch)
    return {
        "correspondence": losses.correspondence_loss(descriptors, batch, scale[0]),
        "with_edges": losses.correspondence_loss(whole, batch, scale[2]),
        "retrieval": losses.retrieval_loss(scores, batch.angle_deg, scale[1]),
    }


class Latents:
    """Pictures -> latents of unit variance, by the autoencoder as trained so far."""

    def __init__(self, place: Place, device: torch.device) -> None:
        saved = _loaded(place.checkpoint("autoencoder"), device)
        self.vae = build_untrained(UNET, VAE)[1].to(device, memory_format=torch.channels_last)
        self.vae.load_state_dict(saved["average"])
        self.vae.eval().requires_grad_(False)
        self.config = VAE | {"scaling_factor": saved["scaling_factor"]}

    @torch.no_grad()
    def __call__(self, rgb: Tensor) -> Tensor:
        """Clean latents."""
        with _mixed(rgb.device):
            latent = encode_latent(self.vae, self.config, to_network_image(rgb, size=128))
        return latent.float().contiguous(memory_format=torch.channels_last)


def prompt(count: int, device: torch.device) -> Tensor:
    """The text that the model does not know."""
    return torch.zeros(PROMPT, device=device).expand(count, -1, -1)


class _Batches(Dataset[Any]):
    """A stage's batches by step, for a loader's workers."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage

    def __getitem__(self, step: int) -> Any:
        return self.stage.batch(step)


def batches(stage: Stage, first: int, workers: int) -> Iterator[Any]:
    """Batches from step ``first`` on, in order, whoever drew them; without workers they are drawn here."""
    steps: Any = range(first, stage.steps)
    if not workers:
        return map(stage.batch, steps)
    drawn = DataLoader(
        _Batches(stage),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        multiprocessing_context="fork",
        worker_init_fn=lambda _: cv2.setNumThreads(0),
    )
    return iter(drawn)


def train(stage: Stage, place: Place, *, until: float, save_every_s: float = 90.0, workers: int = 0) -> bool:
    """Run a stage to its end or to the time ``until``, from its last checkpoint on. Returns whether it ended."""
    optimiser = torch.optim.AdamW(stage.model.parameters(), lr=stage.rate, weight_decay=stage.decay, betas=(0.9, 0.98))
    step = _resumed(stage, optimiser, place)
    saved_at = time.monotonic()
    records: list[dict[str, Any]] = []
    for batch in batches(stage, step, workers):
        if time.time() >= until:
            break
        for group in optimiser.param_groups:
            group["lr"] = stage.rate_at(step)
        terms = stage.loss(batch, step)
        optimiser.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        norm = nn.utils.clip_grad_norm_(stage.model.parameters(), 1.0)
        optimiser.step()
        stage.follow(step)
        records.append({"step": step, **{name: value.detach() for name, value in terms.items()}, "norm": norm})
        step += 1
        if len(records) >= _NOTED or stage.device.type == "cpu":
            _note(place, stage, records)
        if time.monotonic() - saved_at > save_every_s:
            _save(stage, optimiser, step, place)
            saved_at = time.monotonic()
    _note(place, stage, records)
    _save(stage, optimiser, step, place)
    return step >= stage.steps


def _note(place: Place, stage: Stage, records: list[dict[str, Any]]) -> None:
    """Append losses to the curve, and forget them."""
    with place.curve(stage.name).open("a") as curve:
        for record in records:
            step = int(record.pop("step"))
            values = {name: round(float(value), 5) for name, value in record.items()}
            curve.write(json.dumps({"step": step, **values, "at": round(time.time(), 2)}) + "\n")
    records.clear()


def _loaded(path: Path, device: torch.device) -> dict[str, Any]:
    return dict(torch.load(path, map_location=device, weights_only=True))


def _resumed(stage: Stage, optimiser: torch.optim.Optimizer, place: Place) -> int:
    path = place.checkpoint(stage.name)
    if not path.exists():
        return 0
    saved = _loaded(path, stage.device)
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
    image = to_network_image(picture_batch(stage.source, 0, count=32).to(stage.device), size=128)
    return round(1 / float(stage.average.encode(image).latent_dist.mean.std()), 4)


def _mixed(device: torch.device) -> torch.autocast:
    return torch.autocast(device.type, dtype=torch.bfloat16)
