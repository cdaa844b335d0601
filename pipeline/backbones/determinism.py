"""How networks convolve: the same sums on every call, since what is cached must not depend on the turn."""

from __future__ import annotations

from contextlib import AbstractContextManager

import torch


def use_deterministic_convolutions() -> AbstractContextManager[None]:
    """Within it cuDNN picks deterministic algorithms, and float32 products of float32 values."""
    flags: AbstractContextManager[None] = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    return flags
