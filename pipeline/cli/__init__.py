"""Commands other than running the pipeline: ``dzop cache``, ``dzop score`` and ``dzop lint``."""
