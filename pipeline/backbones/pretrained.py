"""A folder written by save_pretrained -> the model, with every weight checked. Used by extract and detect."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from torch import nn

from pipeline.errors import BadInput
from pipeline.io.checkpoints import check_missing, tensor_shapes


def load_pretrained(class_name: str, root: Path, tensors: Sequence[Path], **options: Any) -> nn.Module:
    """A model of the transformers class of that name, on the CPU, with the weights in ``tensors``.

    Raises BadInput for broken files, and for weights that are missing or do not fit config.json: transformers would
    initialise those at random.
    """
    import transformers
    from safetensors import SafetensorError

    cls: Any = getattr(transformers, class_name, None)
    if cls is None:
        found = f"transformers {transformers.__version__}, which has no {class_name}"
        raise BadInput(root, found=found, needed="a newer transformers, or weights of another class")
    for path in tensors:
        tensor_shapes(path)
    fixed = {"local_files_only": True, "use_safetensors": True, "output_loading_info": True}
    fixed["ignore_mismatched_sizes"] = True  # reported below, with its name
    try:
        with silence_libraries():
            model, info = cls.from_pretrained(str(root), **fixed, **options)
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, AttributeError, SafetensorError) as error:
        raise BadInput(
            tensors[0], found=full_text(error), needed=f"weights of a {class_name} for config.json"
        ) from None
    if info["mismatched_keys"]:
        name, stored, needed = min(info["mismatched_keys"])
        raise BadInput(
            f"{tensors[0]}, tensor {name}", found=tuple(stored), needed=f"{tuple(needed)}, as config.json says"
        )
    check_missing(sorted(info["missing_keys"]), tensors[0])
    return _copy_to_memory(model)


def _copy_to_memory(model: nn.Module) -> nn.Module:
    """The model with memory of its own. transformers maps the file, so that writing to it would change the weights."""
    with torch.no_grad():
        for tensor in chain(model.parameters(), model.buffers()):
            tensor.data = tensor.data.clone()
    return model


def full_text(error: Exception) -> str:
    """An error's text on one line; transformers often names the value after the first line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


@contextmanager
def silence_libraries() -> Iterator[None]:
    """Suppress the progress bars and warnings of diffusers and transformers while they read weights."""
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    libraries = (diffusers_logging, transformers_logging)
    before = [library.get_verbosity() for library in libraries]
    for library in libraries:
        library.set_verbosity_error()
        library.disable_progress_bar()
    try:
        yield
    finally:
        for library, verbosity in zip(libraries, before, strict=True):
            library.set_verbosity(verbosity)
            library.enable_progress_bar()
