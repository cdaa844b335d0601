"""Files and folders that are often given in place of weights are named as what they are."""

import json
from pathlib import Path

import pytest

from pipeline.backbones.sam import open_sam_weights
from pipeline.backbones.stable_diffusion.configs import check_unet
from pipeline.backbones.stable_diffusion.source import open_weights
from pipeline.backbones.vit.source import open_folder
from pipeline.errors import BadInput
from pipeline.io.checkpoints import list_shards, read_json, resolve_hub_cache, tensor_shapes

OTHERS = {
    "git-lfs": b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 3438167534\n",
    "web page": b"<!DOCTYPE html>\n<html><head><title>Login</title></head></html>",
    "web page ": b"\n  <html lang='en'><body>502</body></html>",
    "gated": b"Access to model stabilityai/x is restricted. You must be authenticated",
    "error message": b'{"error":"Repository not found"}',
    "empty": b"",
    "pickled": b"PK\x03\x04" + bytes(60),
    "GGUF": b"GGUF\x03\x00\x00\x00",
}


@pytest.mark.parametrize("content", OTHERS)
def test_a_file_in_place_of_weights_is_named(tmp_path, content):
    path = tmp_path / "model.safetensors"
    path.write_bytes(OTHERS[content])
    with pytest.raises(BadInput, match=rf"model\.safetensors: found .*{content.strip()}"):
        tensor_shapes(path)


@pytest.mark.parametrize("content", ["git-lfs", "web page", "empty", "gated"])
def test_a_file_in_place_of_a_config_is_named(tmp_path, content):
    (tmp_path / "config.json").write_bytes(OTHERS[content])
    with pytest.raises(BadInput, match=rf"config\.json: found .*{content}"):
        read_json(tmp_path / "config.json")


def hub_cache(folder: Path, *commits: str) -> Path:
    for name in ("blobs", "refs"):
        (folder / name).mkdir(parents=True)
    for commit in commits:
        (folder / "snapshots" / commit).mkdir(parents=True)
    (folder / "snapshots").mkdir(exist_ok=True)
    return folder


def test_a_hub_cache_of_one_snapshot_stands_for_it(tmp_path):
    assert resolve_hub_cache(hub_cache(tmp_path / "a", "1" * 40), "f") == tmp_path / "a" / "snapshots" / ("1" * 40)
    assert resolve_hub_cache(tmp_path, "f") == tmp_path


@pytest.mark.parametrize("commits", [(), ("1" * 40, "2" * 40)])
@pytest.mark.parametrize(
    "open_", [open_weights, lambda path, revision: open_folder(path, revision, ("vit",), "dino"), open_sam_weights]
)
def test_a_hub_cache_of_other_numbers_of_snapshots_lists_them(tmp_path, commits, open_):
    folder = hub_cache(tmp_path / "models--a--b", *commits)
    with pytest.raises(BadInput, match=r"hub's cache with \d snapshots, needs one of its folders") as refused:
        open_(str(folder), None)
    assert all(commit in str(refused.value) for commit in commits)


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "a/b.safetensors", "..", ""])
def test_an_index_names_files_of_its_own_folder_only(tmp_path, name):
    index = tmp_path / "model.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {"a": "model-1.safetensors", "b": name}}))
    with pytest.raises(BadInput, match="found a shard named"):
        list_shards(index)


@pytest.mark.parametrize(
    "change", [{"layers_per_block": 10**6}, {"layers_per_block": 0}, {"block_out_channels": [32] * 1000}]
)
def test_a_u_net_of_absurd_size_is_refused_at_once(change):
    config = {"_class_name": "UNet2DConditionModel", "block_out_channels": [32, 64], "layers_per_block": 2}
    with pytest.raises(BadInput, match="layers_per_block"):
        check_unet(config | {"cross_attention_dim": 8} | change, Path("config.json"))
