"""How the threads of the libraries behave; they read it from the environment when they are loaded."""

from __future__ import annotations

THREAD_SETTINGS = {
    # PyTorch's threads sleep while they wait instead of spinning, which would slow down a busy machine.
    "OMP_WAIT_POLICY": "PASSIVE",
    # NumPy's matrix products are small here. Its threads would spin after each and take a core from the model.
    "OPENBLAS_NUM_THREADS": "1",
}
