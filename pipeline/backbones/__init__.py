"""Networks behind the extract and detect variants: their code, and how their weights are found and loaded."""
