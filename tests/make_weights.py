"""Writes small models with seeded random weights, of all classes that methods ask for: nothing learned.

    python tests/make_weights.py FOLDER
    make comparison ARGS="$(python tests/make_weights.py FOLDER)"

It prints the overrides that name them; what is there already is kept.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from make_sam import write_sam
from make_sd15 import write_folder
from make_vit import write_vit


def write_weights(root: Path) -> list[str]:
    """Overrides that name the folders."""
    made = {
        "stable_diffusion": write_folder,
        "dino": write_vit,
        "dinov2": lambda path: write_vit(path, "dinov2_with_registers", depth=24),
        "sam": write_sam,
    }
    for name, write in made.items():
        if not (root / name).exists():
            write(root / name)
    return [f"weights.{name}={root / name}" for name in made]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    print(*write_weights(parser.parse_args().folder.resolve()))
