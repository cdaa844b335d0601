"""Commands beside the route: ``dzop cache``, ``dzop score`` and ``dzop lint``."""
