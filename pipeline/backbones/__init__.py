"""Networks behind the extract and detect variants, the loading of their weights, and the extractor's contract."""
