"""Draw the pictures of README.md and docs/: ``python -m docs.pictures`` or ``make pictures``.

Photographs, overlays and cards come from runs of the product on procedural objects; diagrams are drawn here as SVG.
Run twice on one machine, it writes the same bytes.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import PIL.Image

from docs.diagrams import DIAGRAMS
from pipeline.report.panels import GAP_PX, PANEL_PX, TITLE_PX

PICTURES = Path(__file__).parent / "pictures"
PHOTOGRAPH = 2  # image of the demo's scene
MUG = 3  # object with a handle
MUG_XYXY = (640, 480, 1280, 960)  # the quarter of the overlay that shows it
VIEWS = 300  # templates of an object of the demo
MARGIN_PX = 8
EXCERPT = ("name", "status", "T_cam_obj", "confidence", "decision", "inliers", "correspondences")


def main() -> None:
    """Write all pictures, or the diagrams alone."""
    parser = argparse.ArgumentParser(description="Draw the pictures of README.md and docs/.")
    parser.add_argument("--out", type=Path, default=PICTURES, help="folder to write to")
    parser.add_argument("--diagrams", action="store_true", help="only the SVG diagrams, which need no run")
    parser.add_argument("--views", type=int, default=VIEWS, help="templates per object; few for a quick try")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    write_diagrams(asked.out)
    if not asked.diagrams:
        with tempfile.TemporaryDirectory() as folder:
            write_photographs(asked.out, Path(folder), views=asked.views)


def write_diagrams(out: Path) -> None:
    """The SVG diagrams."""
    for name, draw in DIAGRAMS.items():
        (out / name).write_text(draw())


def write_photographs(out: Path, folder: Path, *, views: int) -> None:
    """The demo's overlay, the card of a pose in two layouts, and the overlay and result of a single photograph."""
    demo = run(folder, "dataset=demo", f"select.images=[{PHOTOGRAPH}]", "gallery=0", views=views)
    save(PIL.Image.open(demo / "overlays" / f"000001_{PHOTOGRAPH:06d}.jpg").resize((800, 600)), out / "demo.jpg")
    card = pose_card(folder, views=views)
    save(frame(card), out / "method_narrow.jpg")
    save(frame(landscape(card)), out / "method.jpg")
    own = own_object(folder, views=2 * views)
    overlay = PIL.Image.open(own / "overlays" / "000000_000000.jpg")
    save(overlay.crop(MUG_XYXY), out / "own_object.jpg")
    (pose,) = json.loads((own.parents[1] / "shot" / "pose.json").read_text())["poses"]
    (out / "own_object.json").write_text(json.dumps({name: pose[name] for name in EXCERPT}, indent=1) + "\n")


def run(folder: Path, *overrides: str, views: int) -> Path:
    """Run the product with one thread on the CPU; returns the folder of its results."""
    out = Path(tempfile.mkdtemp(dir=folder))
    shared = [
        f"out={out}",
        f"store.root={folder / 'cache'}",
        "threads=1",
        "runtime.device=cpu",
        f"render.count={views}",
    ]
    data = [f"dataset.root={folder / 'data'}"] if "dataset=demo" in overrides else []
    subprocess.run([sys.executable, "-m", "pipeline", *overrides, *data, *shared], check=True)
    return next(out.glob("*/*/poses.json")).parent


def pose_card(folder: Path, *, views: int) -> PIL.Image.Image:
    """How the mug's pose came about. Without the rerender, so that the card shows a stored template."""
    chosen = [f"select.images=[{PHOTOGRAPH}]", f"select.objects=[{MUG}]"]
    results = run(
        folder,
        "dataset=demo",
        *chosen,
        "second_look=none",
        "cluster=kmeans",
        "overlays=false",
        "gallery=1",
        views=views,
    )
    return PIL.Image.open(next((results / "gallery").glob("*.jpg")))


def own_object(folder: Path, *, views: int) -> Path:
    """Results for a mesh, a photograph and a mask of the demo, as a user would give them."""
    data = next((folder / "data").glob("*/models")).parent
    scene = data / "test" / "000001"
    truths = json.loads((scene / "scene_gt.json").read_text())[str(PHOTOGRAPH)]
    index = [truth["obj_id"] for truth in truths].index(MUG)
    shutil.copy(data / "models" / f"obj_{MUG:06d}.ply", folder / "mug.ply")
    shutil.copy(scene / "rgb" / f"{PHOTOGRAPH:06d}.png", folder / "shot.png")
    shutil.copy(scene / "mask_visib" / f"{PHOTOGRAPH:06d}_{index:06d}.png", folder / "mask.png")
    K = json.loads((scene / "scene_camera.json").read_text())[str(PHOTOGRAPH)]["cam_K"]
    files = [f"dataset.mesh={folder / 'mug.ply'}", f"dataset.image={folder / 'shot.png'}"]
    files += [f"dataset.mask={folder / 'mask.png'}", f"dataset.K=[{','.join(map(str, K))}]"]
    return run(folder, "dataset=photo", *files, views=views)


def landscape(card: PIL.Image.Image) -> PIL.Image.Image:
    """A card's four rows as two by two."""
    width, height = card.width, TITLE_PX + PANEL_PX
    rows = [card.crop((0, top, width, top + height)) for top in range(0, card.height, height + GAP_PX)]
    page = PIL.Image.new("RGB", (2 * width + 2 * GAP_PX, 2 * height + GAP_PX), "white")
    for index, row in enumerate(rows[:4]):
        page.paste(row, (index % 2 * (width + 2 * GAP_PX), index // 2 * (height + GAP_PX)))
    return page


def frame(picture: PIL.Image.Image) -> PIL.Image.Image:
    """The picture with a white margin, so that its titles do not touch a dark page."""
    page = PIL.Image.new("RGB", (picture.width + 2 * MARGIN_PX, picture.height + 2 * MARGIN_PX), "white")
    page.paste(picture, (MARGIN_PX, MARGIN_PX))
    return page


def save(picture: PIL.Image.Image, path: Path) -> None:
    """Write a JPEG."""
    picture.save(path, "JPEG", quality=85, optimize=True)


if __name__ == "__main__":
    main()
