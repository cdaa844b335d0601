"""Deterministic convolutions: cached features must not depend on when they were computed."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch


def use_deterministic_convolutions() -> AbstractContextManager[None]:
    """A context in which cuDNN uses deterministic algorithms and full float32 products (no TF32)."""
    flags: AbstractContextManager[None] = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    return flags
