"""README and docs: length, links, paths, pictures."""

import importlib
import json
import re
import shutil
import tomllib

import PIL.Image
import pytest
from command import run_dzop
from pages import DOCS, PAGES, README, ROOT, anchors, blocks, links, name_of, prose

from pipeline.io.meshes import write_ply
from pipeline.synthetic.objects import make_object

PICTURES = ROOT / "docs" / "pictures"
FOLDERS = ("pipeline", "conf", "tests", "docs", "benchmarks", ".ci", ".github")
PAGE = pytest.mark.parametrize("page", PAGES, ids=name_of)


def test_readme_has_about_900_words_and_fits_a_terminal():
    text = README.read_text()
    assert 750 <= len(text.split()) <= 1000
    assert [line for line in text.splitlines() if len(line) > 120] == []


@pytest.mark.parametrize("page", DOCS, ids=name_of)
def test_a_page_of_docs_is_under_150_lines_and_linked_from_another(page):
    assert len(page.read_text().splitlines()) < 150
    assert any(page == (other.parent / link.split("#")[0]).resolve() for other in PAGES for link in links(other))


@PAGE
def test_links_lead_to_files_and_headings_that_exist(page):
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@PAGE
def test_paths_that_are_named_exist(page):
    words = re.findall(r"`([\w./-]+)`", prose(page)) + [word for _, text in blocks(page) for word in text.split()]
    paths = [word for word in words if "/" in word and word.split("/")[0] in FOLDERS]
    missing = [path for path in paths if re.fullmatch(r"[\w./-]+", path) and not (ROOT / path).exists()]
    assert missing == []


@PAGE
def test_pictures_have_a_text_for_those_who_cannot_see_them(page):
    assert re.findall(r"!\[\]|<img(?![^>]*\balt=)", prose(page)) == []


def test_pictures_are_small_and_all_are_shown():
    files = list(PICTURES.glob("*.*"))
    assert sum(path.stat().st_size for path in files) < 1_500_000
    shown = {(page.parent / link).resolve() for page in PAGES for link in links(page)}
    assert {path for path in files if path.suffix != ".json"} <= shown


def test_diagrams_are_those_that_make_pictures_draws(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    diagrams = importlib.import_module("docs.diagrams").DIAGRAMS
    for name, draw in diagrams.items():
        assert draw() == (PICTURES / name).read_text(), f"make pictures ARGS=--diagrams draws another {name}"


def test_boxes_of_the_route_link_to_their_stages():
    targets = re.findall(r'href="([^"]+)"', (PICTURES / "route.svg").read_text())
    assert len(set(targets)) >= 13
    assert all((PICTURES / target).exists() for target in targets)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_pictures_repeat_to_the_byte(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(ROOT))
    pictures = importlib.import_module("docs.pictures")
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        if name == "second":  # the same scenes, everything else computed again
            shutil.copytree(tmp_path / "first" / "data", tmp_path / "second" / "data")
        card = pictures.pose_card(tmp_path / name, views=12)
        pictures.save(pictures.frame(pictures.landscape(card)), tmp_path / f"{name}.jpg")
    assert (tmp_path / "first.jpg").read_bytes() == (tmp_path / "second.jpg").read_bytes()
    assert PIL.Image.open(tmp_path / "first.jpg").size == PIL.Image.open(PICTURES / "method.jpg").size


def test_the_result_in_readme_is_that_of_make_pictures():
    shown = json.loads(next(text for language, text in blocks(README) if language == "json"))
    computed = json.loads((PICTURES / "own_object.json").read_text())
    assert shown.keys() == computed.keys()
    assert shown.pop("status") == computed.pop("status")
    assert shown.pop("T_cam_obj") == [
        pytest.approx(row, abs=0.05 if abs(row[3]) > 1 else 1e-3) for row in computed.pop("T_cam_obj")
    ]
    assert shown == {name: pytest.approx(value, abs=0.005) for name, value in computed.items()}


def test_errors_in_readme_are_the_programs_own(capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "mug.ply", make_object(3))
    PIL.Image.new("RGB", (640, 480)).save("shot.png")
    PIL.Image.new("L", (320, 240), 255).save("mask.png")
    PIL.Image.new("L", (640, 480), 255).save("fits.png")
    photo = ["dataset=photo", "dataset.mesh=mug.ply", "dataset.image=shot.png", "store=memory", "plan=true"]
    K, mask = "dataset.K=[600,600,320,240]", "dataset.mask=fits.png"
    cases = (
        [K, mask, "dataset.scale=0.0005"],
        [K, "dataset.mask=mask.png"],
        ["dataset.K=[600,600,2000,1500]", mask],
    )
    shown = re.sub(r"\s+", " ", README.read_text())
    for overrides in cases:
        ran = run_dzop(capsys, monkeypatch, *photo, *overrides)
        error = ran.err.strip().splitlines()[-1].removeprefix("error: ")
        assert ran.status == 1
        assert re.sub(r"diameter [\d.]+", "diameter 0.13", error) in shown


def test_architecture_says_where_each_heavy_library_is_imported():
    page = (ROOT / "docs" / "architecture.md").read_text()
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    protected = [contract for contract in contracts if contract["type"] == "protected"]
    importers = {module for contract in protected for module in contract["allowed_importers"]} - {"benchmarks"}
    assert [module for module in importers if module.replace(".", "/") not in page] == []


def test_modules_that_changelog_says_are_there_now_exist():
    rows = re.findall(r"^\| .+ \| (.+) \|$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    modules = re.findall(r"`((?:pipeline|benchmarks)[\w.]+)`", " ".join(rows))
    paths = [ROOT / module.replace(".", "/") for module in modules]
    assert len(paths) > 20
    assert [path for path in paths if not (path.with_suffix(".py").is_file() or (path / "__init__.py").is_file())] == []


def test_the_workflow_runs_every_python_that_the_package_takes():
    requires = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    low, high = (int(minor) for minor in re.findall(r"3\.(\d+)", requires))
    listed = re.findall(r'"3\.(\d+)"', (ROOT / ".github" / "workflows" / "ci.yml").read_text())
    assert [int(minor) for minor in listed] == list(range(low, high))
