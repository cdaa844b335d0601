"""Commands other than running the pipeline: ``dzop cache``, ``fetch``, ``score``, ``lint``."""
