"""One table: the embedded model beside its controls, on objects of a seed that nothing was trained or chosen on."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

TEST_SEED = 9041  # of synthetic.demo; training and validation objects have builders and seeds of their own
DEMO = ("dataset=demo", f"dataset.seed={TEST_SEED}", "dataset.objects=20", "dataset.images=40", "dataset.per_image=5")
SYSTEMS = {
    "embedded, learned": ("method=dzop_learned",),
    "embedded, pure": ("method=dzop_masked", "extract=embedded", "extract.weights=pure"),
    "random weights": ("method=dzop_masked", "extract=random_sd", "extract.noise=none"),
    "pixels": ("method=dzop_masked", "extract=pixels"),
    "HOG": ("method=dzop_masked", "extract=hog"),
}
COLUMNS = ("Acc15_geodesic", "template_error_geodesic_deg", "AR", "AR_MSSD", "AR_MSPD")
QUIET = ("gallery=0", "overlays=false")


def benchmark(folder: Path, *, lmo: Path | None = None, detections: Path | None = None) -> str:
    """Tables in Markdown; every run is cached, an interrupted benchmark goes on where it stopped."""
    parts: dict[str, tuple[str, ...]] = {"objects of the test seed": (*DEMO, f"dataset.root={folder / 'data'}")}
    if lmo is not None:
        parts["LM-O, visible masks"] = ("dataset=lmo", f"dataset.root={lmo}", "evaluate.vsd=false")
        if detections is not None:
            found = ("detect=json", f"detect.path={detections}")
            parts["LM-O, detections"] = (*parts["LM-O, visible masks"], *found)
    return "\n\n".join(_table(title, data, folder) for title, data in parts.items())


def _table(title: str, data: Sequence[str], folder: Path) -> str:
    lines = [f"**{title}**", "", f"| features | {' | '.join(COLUMNS)} |", "|---" * (len(COLUMNS) + 1) + "|"]
    for name, choices in SYSTEMS.items():
        out = folder / "results" / title.replace(",", "").replace(" ", "_") / name.replace(",", "").replace(" ", "_")
        metrics = _run([*data, *choices, *QUIET], out, folder / "cache")
        lines.append(f"| {name} | {' | '.join(_shown(metrics.get(column)) for column in COLUMNS)} |")
    return "\n".join(lines)


def _run(choices: Sequence[str], out: Path, cache: Path) -> dict[str, Any]:
    """The metrics of a run of the pipeline, as its row holds them."""
    where = [f"out={out}", f"store.root={cache}"]
    subprocess.run([sys.executable, "-m", "pipeline", *choices, *where], check=True, stdout=subprocess.DEVNULL)
    newest = max((out / "rows").glob("*.json"), key=lambda path: path.stat().st_mtime)
    return dict(json.loads(newest.read_text())["metrics"])


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if value < 2 else f"{value:.1f}"
