"""What a configuration asks of a run besides its stages and its data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from pipeline.bop.dataset import Dataset
from pipeline.errors import BadInput
from pipeline.items.views import Target
from pipeline.metrics.recall import THETAS
from pipeline.spec import NonNegative, Positive, PositiveFloat, spec

MAX_LISTED = 20  # ids that an error message lists


@spec
class Select:
    """A subset of the targets by id; None keeps all. ``sample``: at most so many of the images, evenly spaced."""

    objects: tuple[int, ...] | None = None
    scenes: tuple[int, ...] | None = None
    images: tuple[int, ...] | None = None
    sample: Positive | None = None

    def targets(self, dataset: Dataset) -> tuple[Target, ...]:
        """The selected targets. Raises BadInput that lists the available ids if none are left."""
        selected = dataset.targets
        for name, field in (("scenes", "scene_id"), ("images", "im_id"), ("objects", "obj_id")):
            wanted = getattr(self, name)
            if wanted is None:
                continue
            available = sorted({getattr(target, field) for target in selected})
            selected = tuple(target for target in selected if getattr(target, field) in wanted)
            if not selected:
                listed = ", ".join(map(str, available[:MAX_LISTED])) + (", ..." if len(available) > MAX_LISTED else "")
                raise BadInput(f"select.{name}", found=list(wanted), needed=f"some of the targets' {name}: {listed}")
        return selected if self.sample is None else self._sample(selected, self.sample)

    @staticmethod
    def _sample(targets: tuple[Target, ...], count: int) -> tuple[Target, ...]:
        """The targets of ``count`` evenly spaced images."""
        images = sorted({(target.scene_id, target.im_id) for target in targets})
        count = min(count, len(images))
        chosen = {images[i * len(images) // count] for i in range(count)}
        return tuple(target for target in targets if (target.scene_id, target.im_id) in chosen)


@spec
class Evaluate:
    """How poses are scored.

    ``models``: folder of the meshes that errors are measured on; the dataset's own meshes if it does not exist.
    ``vsd_delta_mm``: how far behind the measured depth a surface still counts as visible (BOP: 15).
    ``theta_max``: thresholds above it are left out of the averages. ``correspondences``: also score correspondences.
    """

    vsd: bool = True
    vsd_delta_mm: PositiveFloat = 15.0
    models: str = "models_eval"
    theta_max: Annotated[float, Field(ge=0.05, le=0.5)] = 0.5
    correspondences: bool = False

    def check_theta_max(self) -> None:
        """Raise BadInput unless ``theta_max`` is one of BOP's thresholds."""
        if not np.isclose(THETAS, self.theta_max).any():
            needed = f"one of BOP's thresholds: {', '.join(f'{theta:g}' for theta in THETAS)}"
            raise BadInput("evaluate.theta_max", found=self.theta_max, needed=needed)

    def models_folder(self, dataset: Dataset) -> str:
        """Folder of the meshes to measure on, relative to the dataset. Raises BadInput if a named one is missing."""
        if (dataset.root / self.models).is_dir():
            return self.models
        if self.models != Evaluate.models:
            where = dataset.root / self.models
            raise BadInput(where, found="no such folder", needed="the meshes that evaluate.models names")
        return dataset.models


@spec
class Options:
    """What to do and where to write the results.

    ``label``: variant of every stage; ``config``: the complete configuration; ``resume``: skip a run whose record says
    that it is finished (jobs of a sweep). ``confidence``: see choose_calibration.
    """

    step: Literal["all", "onboard", "detect", "estimate", "evaluate", "report"]
    plan: bool
    out: str
    overlays: bool
    gallery: NonNegative
    sweep: str | None
    evaluate: Evaluate
    threads: NonNegative
    method: str
    select: Select
    label: Mapping[str, str]
    config: Mapping[str, Any]
    resume: bool = False
    confidence: str = "auto"

    @property
    def name(self) -> str:
        """Method and extractor, "rgbd" with depth; without underscores, as BOP's format requires of file names."""
        use, given = self.config["depth"]["use"], self.config["dataset"].get("depth")
        depth = "-rgbd" if use == "always" or (use == "given" and given) else ""
        return f"{self.method}-{self.label['extract']}{depth}".replace("_", "-")

    @property
    def file_name(self) -> str:
        """``name`` and the detect variant: the method in the name of the results file."""
        return f"{self.name}-{self.label['detect']}".replace("_", "-")
