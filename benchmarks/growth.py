"""How the cost of poses grows with templates, detections in an image, objects, and the size of the photographs.

Every point is a run of the command line in its own process, with templates onboarded before, so that it computes query
features and poses only. Except for the growth with templates, features are raw pixels, which cost little.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from benchmarks.cli_runs import run_dzop
from benchmarks.measure import Measurement
from pipeline.report.plotting import COLOURS, Figure, one_panel

TEMPLATES = (75, 300, 1200)
DETECTIONS = (1, 8, 64)
OBJECTS = (1, 10, 30)
MEGAPIXELS = (0.3, 3.0, 12.0)
_CHEAP = ("method=dzop", "extract=pixels", "render.count=24")
_DEMO = ("dataset=demo",)
Commands = Sequence[tuple[str, ...]]


def growth(*, device: str, repeats: int, plots: Path = Path("results/bench")) -> list[Measurement]:
    """CPU seconds and peak memory at each point, and the growth of the time relative to linear growth.

    Writes one plot per quantity to ``plots``.
    """
    chosen = (f"runtime.device={device}", "step=estimate")
    measurements: list[Measurement] = []
    plots.mkdir(parents=True, exist_ok=True)
    parts: dict[str, tuple[Sequence[float], Callable[[Path, float], Commands]]] = {
        "templates": (TEMPLATES, _with_templates),
        "detections in an image": (DETECTIONS, _with_detections),
        "objects": (OBJECTS, _with_objects),
        "megapixels of a photograph": (MEGAPIXELS, _with_pixels),
    }
    for what, (points, commands) in parts.items():
        seconds, peaks = [], []
        for point in points:
            with tempfile.TemporaryDirectory() as name:
                first, again = commands(Path(name), point)
                run_dzop(Path(name), *chosen, *first)
                empty = run_dzop(Path(name), *chosen, *first)
                usage = run_dzop(Path(name), *chosen, *again)
                seconds.append(max(usage.cpu_s - empty.cpu_s, 1e-3))
                peaks.append(usage.peak_mb)
        measurements += _summarise(what, points, seconds, peaks)
        _plot(what, points, seconds, peaks).save(str(plots / what.replace(" ", "_")))
    return measurements


def _with_templates(folder: Path, count: float) -> Commands:
    """Poses of dzop_x; another seed of the solver makes the second run compute them again."""
    size = (*_DEMO, "dataset.objects=1", "dataset.images=4", "dataset.per_image=1", f"render.count={count:g}")
    return size, (*size, "solve.seed=1")


def _with_detections(folder: Path, count: float) -> Commands:
    size = (*_DEMO, "dataset.objects=2", "dataset.images=1", f"dataset.per_image={count:g}", *_CHEAP)
    return size, (*size, "crop.padding_ratio=1.21")


def _with_objects(folder: Path, count: float) -> Commands:
    size = (*_DEMO, f"dataset.objects={count:g}", f"dataset.images={count:g}", "dataset.per_image=1", *_CHEAP)
    return size, (*size, "solve.seed=1")


def _with_pixels(folder: Path, megapixels: float) -> Commands:
    """Enlarged photographs of the demo; another crop makes the second run read them again."""
    size = ("dataset.objects=1", "dataset.images=2", "dataset.per_image=1")
    run_dzop(folder, *_DEMO, *size, *_CHEAP, "step=detect")
    (made,) = (folder / "data").iterdir()
    enlarge_photographs(made / "test" / "000001", megapixels)
    chosen = ("dataset=bop", "dataset.name=enlarged", f"dataset.root={made}", *_CHEAP)
    return chosen, (*chosen, "crop.padding_ratio=1.21")


def enlarge_photographs(scene: Path, megapixels: float) -> None:
    """Scale photographs, masks, boxes and camera matrices of a scene to this many megapixels; remove depth."""
    cameras, boxes = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt_info"))
    for path in sorted(scene.glob("*/*.png")) + sorted(scene.glob("*/*.jpg")):
        if path.parent.name == "depth":
            path.unlink()
            continue
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        scale = np.sqrt(megapixels * 1e6 / (image.shape[0] * image.shape[1]))
        smooth = cv2.INTER_LINEAR if path.parent.name == "rgb" else cv2.INTER_NEAREST
        cv2.imwrite(str(path), cv2.resize(image, None, fx=scale, fy=scale, interpolation=smooth))
    for camera in cameras.values():
        K = np.array(camera["cam_K"]).reshape(3, 3)
        K[:2] *= scale
        K[:2, 2] += (scale - 1) / 2  # pixel centres are integers
        camera["cam_K"] = K.ravel().tolist()
    for seen in (seen for of_image in boxes.values() for seen in of_image):
        seen |= {name: [round(scale * x) for x in value] for name, value in seen.items() if name.startswith("bbox")}
    for name, content in (("camera", cameras), ("gt_info", boxes)):
        (scene / f"scene_{name}.json").write_text(json.dumps(content))


def _summarise(
    what: str, points: Sequence[float], seconds: Sequence[float], peaks: Sequence[float]
) -> list[Measurement]:
    found = [
        Measurement(f"{point:g} {what}: {name}", value, unit)
        for point, time_s, peak in zip(points, seconds, peaks, strict=True)
        for name, value, unit in (("time", time_s, "s of one core"), ("peak memory", peak, "MB"))
    ]
    times = seconds[-1] / seconds[0] / (points[-1] / points[0])
    return [
        *found,
        Measurement(f"{what}: growth of the time", times, "x", "linear growth", 1.0),
        Measurement(f"{what}: peak memory", peaks[-1] / peaks[0], "x", f"that of {points[0]:g}"),
    ]


def _plot(what: str, points: Sequence[float], seconds: Sequence[float], peaks: Sequence[float]) -> Figure:
    """Log-log plot of time and memory over the points, with linear growth from the first point."""
    canvas, axes = one_panel()
    axes.loglog(points, seconds, "o-", color=COLOURS[0], label="s of one core")
    axes.loglog(points, [seconds[0] * p / points[0] for p in points], ":", color=COLOURS[6], label="linear growth")
    axes.loglog(points, [peak / 1000 for peak in peaks], "s-", color=COLOURS[1], label="peak memory, GB")
    axes.set_xticks(list(points), [f"{p:g}" for p in points])
    axes.set_xlabel(what)
    axes.legend()
    return Figure(what.replace(" ", "_"), f"Time and peak memory of a run against {what}", canvas)
