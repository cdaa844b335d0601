"""Commands other than running the pipeline: ``dzop cache``, ``fetch``, ``reproduce``, ``score``, ``lint``,
``symmetry``.
"""
