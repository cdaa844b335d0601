"""A checkpoint in the original layout gives the features of the diffusers folder it was made from."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from make_sd15 import write_folder
from safetensors.torch import load_file, save_file

from pipeline.errors import BadInput
from pipeline.items.views import Crops
from pipeline.spec import Runtime, build
from pipeline.stages.extract.stable_diffusion import StableDiffusion

CPU = Runtime(device="cpu", batch=2)
UNET_NAMES = {
    "conv_in.": "input_blocks.0.0.",
    "time_embedding.linear_1.": "time_embed.0.",
    "time_embedding.linear_2.": "time_embed.2.",
    "conv_norm_out.": "out.0.",
    "conv_out.": "out.2.",
    "mid_block.resnets.0.": "middle_block.0.",
    "mid_block.attentions.0.": "middle_block.1.",
    "mid_block.resnets.1.": "middle_block.2.",
}
RESNET_NAMES = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
OPEN_CLIP_NAMES = {
    "layer_norm1": "ln_1",
    "layer_norm2": "ln_2",
    "mlp.fc1": "mlp.c_fc",
    "mlp.fc2": "mlp.c_proj",
    "self_attn.out_proj": "attn.out_proj",
}


def ldm_unet(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    def down(m: re.Match) -> str:
        i, kind, j = int(m[1]), m[2], int(m[3])
        part = {"resnets": ".0.", "attentions": ".1.", "downsamplers": ".0.op."}[kind]
        return f"input_blocks.{3 * i + (3 if kind == 'downsamplers' else 1 + j)}{part}"

    def up(m: re.Match) -> str:
        i, kind, j = int(m[1]), m[2], int(m[3])
        part = {"resnets": ".0.", "attentions": ".1.", "upsamplers": ".1.conv." if i == 0 else ".2.conv."}[kind]
        return f"output_blocks.{3 * i + (2 if kind == 'upsamplers' else j)}{part}"

    named = {}
    for name, tensor in state.items():
        new = name
        for theirs, ldm in UNET_NAMES.items():
            new = ldm + new[len(theirs) :] if new.startswith(theirs) else new
        new = re.sub(r"down_blocks\.(\d)\.(\w+)\.(\d)\.(?:conv\.(?=\w+$))?", down, new) if "down_blocks" in new else new
        new = re.sub(r"up_blocks\.(\d)\.(\w+)\.(\d)\.(?:conv\.(?=\w+$))?", up, new) if "up_blocks" in new else new
        if "resnets" in name:
            new = re.sub("|".join(RESNET_NAMES), lambda m: RESNET_NAMES[m[0]], new)
        named["model.diffusion_model." + new] = tensor
    return named


def ldm_vae(state: dict[str, torch.Tensor], levels: int = 4) -> dict[str, torch.Tensor]:
    named = {}
    for name, tensor in state.items():
        new = re.sub(r"down_blocks\.(\d)\.resnets\.", r"down.\1.block.", name)
        new = re.sub(r"down_blocks\.(\d)\.downsamplers\.0\.", r"down.\1.downsample.", new)
        new = re.sub(r"up_blocks\.(\d)\.resnets\.", lambda m: f"up.{levels - 1 - int(m[1])}.block.", new)
        new = re.sub(r"up_blocks\.(\d)\.upsamplers\.0\.", lambda m: f"up.{levels - 1 - int(m[1])}.upsample.", new)
        new = re.sub(r"mid_block\.resnets\.(\d)\.", lambda m: f"mid.block_{int(m[1]) + 1}.", new)
        new = new.replace("conv_norm_out", "norm_out").replace("conv_shortcut", "nin_shortcut")
        if "attentions" in new:
            new = new.replace("mid_block.attentions.0.", "mid.attn_1.").replace("group_norm", "norm")
            new = re.sub(r"to_([qkv])\.", r"\1.", new).replace("to_out.0.", "proj_out.")
            tensor = tensor[:, :, None, None] if tensor.ndim == 2 else tensor
        named["first_stage_model." + new] = tensor.contiguous()
    return named


def ldm_text(state: dict[str, torch.Tensor], version: int) -> dict[str, torch.Tensor]:
    state = {name.removeprefix("text_model."): tensor for name, tensor in state.items()}
    if version == 1:
        return {f"cond_stage_model.transformer.text_model.{name}": tensor for name, tensor in state.items()}
    named = {
        "token_embedding.weight": state["embeddings.token_embedding.weight"],
        "positional_embedding": state["embeddings.position_embedding.weight"],
        "ln_final.weight": state["final_layer_norm.weight"],
        "ln_final.bias": state["final_layer_norm.bias"],
        "text_projection": torch.zeros(32, 32),
        "logit_scale": torch.zeros(()),
    }
    for name, tensor in state.items():
        if found := re.match(r"encoder\.layers\.(\d+)\.(.+)\.(weight|bias)$", name):
            layer, part, kind = f"transformer.resblocks.{found[1]}", found[2], found[3]
            if part.endswith(".q_proj"):
                qkv = [state[name.replace("q_proj", f"{x}_proj")] for x in "qkv"]
                named[f"{layer}.attn.in_proj_{kind}"] = torch.cat(qkv)
            elif not part.endswith("_proj") or part.endswith("out_proj"):
                named[f"{layer}.{OPEN_CLIP_NAMES[part]}.{kind}"] = tensor
    # OpenCLIP has one layer more than SD 2.x reads
    unread = {k.replace(".1.", ".2."): torch.randn_like(v) for k, v in named.items() if "resblocks.1." in k}
    return {f"cond_stage_model.model.{name}": tensor.clone() for name, tensor in (named | unread).items()}


def checkpoint(folder: Path, version: int) -> dict[str, torch.Tensor]:
    unet = load_file(folder / "unet" / "diffusion_pytorch_model.safetensors")
    vae = load_file(folder / "vae" / "diffusion_pytorch_model.safetensors")
    text = load_file(folder / "text_encoder" / "model.safetensors")
    rest = {"model_ema.decay": torch.zeros(()), "alphas_cumprod": torch.zeros(1000)}
    return ldm_unet(unet) | ldm_vae(vae) | ldm_text(text, version) | rest


@pytest.fixture(scope="module", params=[1, 2], ids=["sd1", "sd2"])
def both(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same weights as a folder and as one file."""
    root = tmp_path_factory.mktemp("single")
    folder = write_folder(root / "folder", version=request.param)
    save_file(checkpoint(folder, request.param), root / "all.safetensors")
    return folder, root / "all.safetensors"


def extractor(weights: Path, **fields: object) -> StableDiffusion:
    return build(StableDiffusion, {"weights": str(weights), "input_size": 128} | fields, where="extract")


def some_crops() -> Crops:
    rgb = np.random.default_rng(0).integers(0, 256, (2, 64, 64, 3), dtype=np.uint8)
    return Crops(rgb, np.ones((2, 64, 64), bool), np.tile(np.eye(3), (2, 1, 1)))


def test_one_file_gives_the_features_of_the_folder(both: tuple[Path, Path]) -> None:
    folder, file = (extractor(path).load(CPU) for path in both)
    torch.testing.assert_close(file.model.prompt, folder.model.prompt, rtol=0, atol=1e-6)
    ours, theirs = (backbone(some_crops(), [2, 5, 8, 11]) for backbone in (file, folder))
    for k in ours:
        # the same weights in the same order of sums; 1e-5 of the largest value for the blocking of matrices
        assert (ours[k] - theirs[k]).abs().max() <= 1e-5 * theirs[k].abs().max()


def test_shapes_alone_give_the_configuration(both: tuple[Path, Path]) -> None:
    folder, file = (extractor(path) for path in both)
    for k in range(12):
        assert file.feature_shape(k) == folder.feature_shape(k)
    ours, theirs = file.configs, folder.configs
    for name in ("block_out_channels", "layers_per_block", "cross_attention_dim", "attention_head_dim"):
        assert ours.unet[name] == theirs.unet[name]
    np.testing.assert_array_equal(ours.alphas_cumprod, theirs.alphas_cumprod)


def test_its_key_depends_on_its_bytes_and_not_its_path(both: tuple[Path, Path], tmp_path: Path) -> None:
    _, file = both
    moved = tmp_path / "renamed.safetensors"
    moved.write_bytes(file.read_bytes())
    assert extractor(moved).recipe() == extractor(file).recipe()


def test_a_folder_and_a_file_of_the_same_weights_have_the_same_key(both: tuple[Path, Path]) -> None:
    folder, file = (extractor(path) for path in both)
    assert file.recipe() == folder.recipe()
    assert file.model == folder.model


def test_every_tensor_that_is_used_enters_the_key_and_no_other(both: tuple[Path, Path], tmp_path: Path) -> None:
    tensors, changed = load_file(both[1]), tmp_path / "changed.safetensors"
    is_sd2 = "model.diffusion_model.middle_block.1.proj_in.weight" in tensors and any(
        name.startswith("cond_stage_model.model.") for name in tensors
    )

    def key(name: str) -> str:
        save_file(tensors | {name: tensors[name] + 1}, changed)
        return extractor(changed).recipe()["weights"]

    whole = extractor(both[1]).recipe()["weights"]
    text = (
        "cond_stage_model.model.transformer.resblocks.0.attn.in_proj_bias"
        if is_sd2
        else "cond_stage_model.transformer.text_model.encoder.layers.0.self_attn.k_proj.bias"
    )
    used = (
        text,
        "model.diffusion_model.input_blocks.1.0.in_layers.2.weight",
        "model.diffusion_model.out.2.bias",
        "first_stage_model.quant_conv.bias",
        "first_stage_model.encoder.mid.attn_1.q.weight",
    )
    assert len({whole, *map(key, used)}) == len(used) + 1
    unused = ("model_ema.decay", "alphas_cumprod", "first_stage_model.decoder.conv_in.bias")
    assert {key(name) for name in (*unused, *(("cond_stage_model.model.text_projection",) if is_sd2 else ()))} == {
        whole
    }


def test_half_precision_of_a_file_is_that_of_a_folder(both: tuple[Path, Path], tmp_path: Path) -> None:
    folder, file = Path(shutil.copytree(both[0], tmp_path / "half")), tmp_path / "half.safetensors"
    for path in folder.rglob("*.safetensors"):
        save_file({name: tensor.half() for name, tensor in load_file(path).items()}, path)
    save_file({name: tensor.half() for name, tensor in load_file(both[1]).items()}, file)
    assert extractor(file).recipe() == extractor(folder).recipe()
    assert extractor(file).recipe()["weights"] != extractor(both[1]).recipe()["weights"]
    rounded = {name: tensor.half().float() for name, tensor in load_file(both[1]).items()}
    save_file(rounded, tmp_path / "rounded.safetensors")
    assert extractor(tmp_path / "rounded.safetensors").recipe() == extractor(file).recipe()
    for dtype in ("float16", "float32"):
        ours, theirs = (extractor(path, dtype=dtype).load(CPU)(some_crops(), [2, 11]) for path in (file, folder))
        for k in ours:
            assert ours[k].dtype == getattr(torch, dtype)
            assert torch.equal(ours[k], theirs[k])


def test_upcast_attention_changes_nothing(both: tuple[Path, Path], tmp_path: Path) -> None:
    """SD 2.1's config sets it, which a single file cannot show. torch's fused attention sums in float32 anyway."""
    folder = Path(shutil.copytree(both[0], tmp_path / "upcast"))
    config = folder / "unet" / "config.json"
    config.write_text(json.dumps(json.loads(config.read_text()) | {"upcast_attention": True}))
    assert extractor(folder).recipe() == extractor(both[1]).recipe()
    path = folder / "unet" / "diffusion_pytorch_model.safetensors"
    # logits beyond float16's largest value, 65504
    save_file({n: 300 * t if re.search(r"attn\d\.to_[qk]", n) else t for n, t in load_file(path).items()}, path)
    plain = Path(shutil.copytree(folder, tmp_path / "plain"))
    (plain / "unet" / "config.json").write_text((both[0] / "unet" / "config.json").read_text())
    for dtype in ("float16", "float32"):
        ours, theirs = (extractor(path, dtype=dtype).load(CPU)(some_crops(), [2, 11]) for path in (folder, plain))
        for k in ours:
            assert torch.isfinite(ours[k]).all()
            assert torch.equal(ours[k], theirs[k])


def test_a_prompt_needs_a_tokenizer_which_one_file_does_not_hold(both: tuple[Path, Path]) -> None:
    with pytest.raises(BadInput, match=r"extract\.prompt: found 'a red duck' and no tokenizer at .*all\.safetensors"):
        extractor(both[1], prompt="a red duck").load(CPU)


def test_missing_tensors_and_other_models_are_named(both: tuple[Path, Path], tmp_path: Path) -> None:
    tensors = load_file(both[1])

    def refusal(changed: dict[str, torch.Tensor]) -> str:
        path = tmp_path / "changed.safetensors"
        save_file(changed, path)
        with pytest.raises(BadInput) as caught:
            extractor(path).load(CPU)
        assert "\n" not in str(caught.value)
        assert str(path) in str(caught.value)
        return str(caught.value)

    without = {k: v for k, v in tensors.items() if not k.startswith("first_stage_model.")}
    assert "no tensor first_stage_model.*" in refusal(without)
    lost = "model.diffusion_model.output_blocks.4.0.in_layers.2.weight"
    assert "no tensor for up_blocks.1.resnets.1.conv1.weight (1 missing)" in refusal(
        {k: v for k, v in tensors.items() if k != lost}
    )
    xl = tensors | {"model.diffusion_model.label_emb.0.0.weight": torch.zeros(1)}
    assert "not XL" in refusal(xl)
    first = "model.diffusion_model.input_blocks.0.0.weight"
    inpainting = tensors | {first: torch.zeros(tensors[first].shape[0], 9, 3, 3)}
    assert "in_channels 9" in refusal(inpainting)
    assert "no tensor" in refusal({"conv_in.weight": torch.zeros(1)})


def test_a_truncated_file_is_named(both: tuple[Path, Path], tmp_path: Path) -> None:
    path = tmp_path / "cut.safetensors"
    path.write_bytes(both[1].read_bytes()[:-1000])
    with pytest.raises(BadInput, match=r"cut\.safetensors.*a complete safetensors file"):
        extractor(path).recipe()
