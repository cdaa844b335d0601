"""Zero-shot 6DoF object poses from diffusion features."""

import os

__version__ = "0.1.0"

# Before torch starts its threads: on a busy machine threads that spin while they wait slow small operations tenfold.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
