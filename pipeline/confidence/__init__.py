"""How far a pose can be trusted: its evidence, and the probability that it is right."""
