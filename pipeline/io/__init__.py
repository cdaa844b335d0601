"""Files: reading and writing them, their digests, checkpoints of models, meshes."""
