"""The demo dataset, generated on first use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

from pipeline.bop.dataset import Dataset, open_dataset
from pipeline.bop.jsonio import read_json
from pipeline.errors import BadInput
from pipeline.spec import Fraction, NonNegative, Positive, Spec, digest, spec
from pipeline.synthetic.scenes import GENERATOR_VERSION, INFO, write_dataset


@spec
class DemoConfig(Spec):
    """Procedural objects in cluttered, partly occluded scenes with exact ground truth.

    ``root`` has one folder for each combination of the other fields. ``per_image``: objects per image. ``occluded``:
    share of the instances that a distractor hides in part.
    """

    kind: ClassVar[str] = "dataset.demo"

    root: str = "data/demo"
    name: str = "demo"
    objects: Positive = 3
    images: Positive = 6
    per_image: Positive = 3
    occluded: Fraction = 0.5
    seed: NonNegative = 0

    def open(self) -> Dataset:
        """The dataset. Raises BadInput if its folder cannot be written."""
        chosen: dict[str, Any] = {k: v for k, v in asdict(self).items() if k not in ("root", "name")}
        version = {} if GENERATOR_VERSION == 1 else {"generator": GENERATOR_VERSION}
        root = Path(self.root).expanduser() / digest(chosen | version)[:8]
        if not root.exists():
            print(f"writing {self.images} images of {self.objects} procedural objects to {root}", flush=True)
            try:
                write_dataset(root, **chosen)
            except (OSError, BadInput) as error:
                if not (root / INFO).is_file():  # otherwise another process wrote the same bytes first
                    why = error.strerror if isinstance(error, OSError) else error
                    raise BadInput("dataset.root", found=f"{root} ({why})", needed="a folder to write to") from None
        _check_generated(root, chosen)
        return open_dataset(root, name=self.name)


def _check_generated(root: Path, chosen: Mapping[str, Any]) -> None:
    """Raise BadInput for a folder that this version of the generator did not write with these arguments."""
    needed = f"what version {GENERATOR_VERSION} of the generator writes: delete {root}, and it is written again"
    info = read_json(root / INFO) if (root / INFO).is_file() else None
    if not isinstance(info, dict):
        raise BadInput(root / INFO, found="no such file" if info is None else "no JSON object", needed=needed)
    for name, value in {**chosen, "generator": GENERATOR_VERSION}.items():
        found = info.get(name, 1 if name == "generator" else None)  # the first version did not write its number
        if found != value:
            raise BadInput(f"{root / INFO}, field {name}", found=found, needed=needed)
