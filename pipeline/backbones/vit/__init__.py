"""Vision transformers of the transformers library: their features, and the folder with their weights."""
