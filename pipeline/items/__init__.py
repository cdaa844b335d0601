"""Data passed between stages: frozen dataclasses of arrays and tensors."""
