"""Files: atomic writes, digests, model checkpoints and meshes."""
