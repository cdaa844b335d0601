"""Nouns that travel between the steps: frozen dataclasses of arrays and tensors."""
