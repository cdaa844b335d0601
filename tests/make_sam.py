"""Writes small SAM and SAM 2 models with random weights, as transformers would."""

from pathlib import Path
from typing import Any

import torch
from transformers import (
    Sam2Config,
    Sam2MaskDecoderConfig,
    Sam2Model,
    Sam2PromptEncoderConfig,
    Sam2VisionConfig,
    SamConfig,
    SamMaskDecoderConfig,
    SamModel,
    SamPromptEncoderConfig,
    SamVisionConfig,
)

SIDE, WIDTH = 64, 16


def write_sam(folder: Path, *, version: int = 1, seed: int = 0) -> Path:
    """The folder. Weights are drawn wide enough that masks have an inside and an outside."""
    torch.manual_seed(seed)
    model: Any = SamModel(sam_config()) if version == 1 else Sam2Model(sam2_config())
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        if parameter.ndim > 1:
            spread = parameter[0].numel() ** -0.5
            parameter.data = 2 * spread * torch.randn(parameter.shape, generator=generator)
    model.tie_weights()
    model.save_pretrained(folder)
    return folder


def sam_config() -> SamConfig:
    vision = SamVisionConfig(
        hidden_size=WIDTH, output_channels=WIDTH, num_hidden_layers=2, num_attention_heads=2, image_size=SIDE,
        patch_size=8, window_size=4, global_attn_indexes=[1], num_pos_feats=WIDTH // 2, mlp_dim=2 * WIDTH,
        initializer_range=0.02,
    )  # fmt: skip
    prompt = SamPromptEncoderConfig(hidden_size=WIDTH, image_size=SIDE, patch_size=8, mask_input_channels=4)
    decoder = SamMaskDecoderConfig(hidden_size=WIDTH, mlp_dim=2 * WIDTH, num_attention_heads=2, iou_head_hidden_dim=8)
    return SamConfig(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)


def sam2_config() -> Sam2Config:
    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "num_attention_heads": 1, "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 2, 1, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 2, 2, 2], "window_size_per_stage": [8, 4, 4, 4],
        "global_attention_blocks": [2], "window_positional_embedding_background_size": [4, 4],
    }  # fmt: skip
    vision = Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]], fpn_hidden_size=WIDTH,
    )  # fmt: skip
    prompt = Sam2PromptEncoderConfig(hidden_size=WIDTH, image_size=SIDE, patch_size=16, mask_input_channels=4)
    decoder = Sam2MaskDecoderConfig(hidden_size=WIDTH, mlp_dim=2 * WIDTH, num_attention_heads=2, iou_head_hidden_dim=8)
    return Sam2Config(vision_config=vision, prompt_encoder_config=prompt, mask_decoder_config=decoder)
