"""The machine: settings of memory allocator and threads for the whole process.

The command line makes the settings at its start, before it imports PyTorch.
"""

import ctypes

# Libraries read these variables when they are loaded.
THREAD_SETTINGS = {
    # PyTorch's threads sleep while they wait instead of spinning, which would slow down a busy machine. But waking one
    # takes as long as a small operation, so that they spin for some 0.5 ms before (GNU OpenMP).
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "10000",
    # NumPy's matrix products are small here. Its threads would spin after each and take a core from the model.
    "OPENBLAS_NUM_THREADS": "1",
}

# Parameters of mallopt(3).
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
# What glibc's own threshold becomes in a process that frees large blocks.
_USUAL_MMAP_THRESHOLD = 32 << 20


def keep_freed_memory() -> None:
    """Keeps freed blocks for the next tensor of their size instead of returning them to the kernel.

    By default every tensor over 32 MiB is mapped, zeroed page by page and unmapped again. In ResNet-50 on six images
    that caused 2.4 million page faults and took half of the time.
    """
    _call_glibc("mallopt", _M_MMAP_THRESHOLD, 1 << 30)
    _call_glibc("mallopt", _M_TRIM_THRESHOLD, (1 << 31) - 1)


def return_freed_memory() -> None:
    """Goes back to glibc's default behaviour, and returns the memory that is free now to the kernel."""
    _call_glibc("mallopt", _M_MMAP_THRESHOLD, _USUAL_MMAP_THRESHOLD)
    _call_glibc("mallopt", _M_TRIM_THRESHOLD, 2 * _USUAL_MMAP_THRESHOLD)
    trim_memory()


def trim_memory() -> None:
    """Returns the memory that is free now to the kernel.

    Kept blocks of many sizes fit no new tensor: a training with images of many sizes grew from 7 to 11 GB in 4 steps.
    """
    _call_glibc("malloc_trim", 0)


def _call_glibc(name: str, *arguments: int) -> None:
    """Calls a function of the C library. Does nothing where that is not glibc."""
    function = getattr(ctypes.CDLL(None), name, None)
    if function is not None:
        function(*arguments)
