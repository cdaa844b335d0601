"""Vision transformers of the transformers library: their features, and the folder their weights come from."""
