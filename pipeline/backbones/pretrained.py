"""A folder as transformers saves it -> the model, whole and quietly. Home of what extract and detect both load."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torch import nn

from pipeline.errors import BadInput
from pipeline.io.checkpoints import check_missing, tensor_shapes


def load_pretrained(class_name: str, root: Path, tensors: Sequence[Path], **options: Any) -> nn.Module:
    """The model of a class of transformers, on the CPU, with the weights in ``tensors``.

    Raises BadInput for files that are broken, and for weights that are missing or do not fit config.json, which
    transformers would draw at random.
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
    fixed["ignore_mismatched_sizes"] = True  # told below, by name
    try:
        with silence_libraries():
            model, told = cls.from_pretrained(str(root), **fixed, **options)
    except (OSError, ValueError, RuntimeError, KeyError, TypeError, AttributeError, SafetensorError) as error:
        raise BadInput(
            tensors[0], found=full_text(error), needed=f"weights of a {class_name} for config.json"
        ) from None
    if told["mismatched_keys"]:
        name, stored, needed = min(told["mismatched_keys"])
        raise BadInput(
            f"{tensors[0]}, tensor {name}", found=tuple(stored), needed=f"{tuple(needed)}, as config.json says"
        )
    check_missing(sorted(told["missing_keys"]), tensors[0])
    return model


def full_text(error: Exception) -> str:
    """All of an error's text on one line; the first line alone often names no value."""
    return " ".join(str(error).split())[:200] or type(error).__name__


@contextmanager
def silence_libraries() -> Iterator[None]:
    """Without the progress bars and remarks of diffusers and transformers while they read weights."""
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
