"""The lines of the demo's output that README shows are lines that the program prints, with other numbers."""

import re

from command import run_dzop
from pages import README, blocks

TINY = (
    "dataset.objects=1", "dataset.images=2", "dataset.per_image=1", "dataset.occluded=0", "render.count=12",
    "threads=1", "runtime.device=cpu", "overlays=false", "gallery=0",
)  # fmt: skip


def test_the_demo_prints_the_lines_that_readme_shows(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    printed = run_dzop(capsys, monkeypatch, *TINY).out + run_dzop(capsys, monkeypatch, "step=report").out
    shown = next(text for _, text in blocks(README) if "AR_MSSD" in text).splitlines()
    assert len(shown) == 6
    patterns = [r"\s+".join(re.sub(r"\\?\d+", r"\\d+", re.escape(word)) for word in line.split()) for line in shown]
    assert [line for line, pattern in zip(shown, patterns, strict=True) if not re.search(pattern, printed)] == []
