"""How fast each part is against a named reference in the same run, and which targets it meets: ``make bench``."""
