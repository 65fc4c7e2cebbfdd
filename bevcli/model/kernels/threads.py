"""Compiled loops shared out among threads, as many as PyTorch uses itself."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

# More ranges than threads: where another process holds up one thread, the others take over its ranges.
RANGES_PER_THREAD = 8


def in_threads(work: Callable[[int, int], None], rows: int, min_range: int = 64) -> None:
    """Calls work(begin, end) for ranges that together make up 0 to rows; work must release the GIL.

    min_range: rows that are not worth sharing out. Idle threads sleep; an exception in `work` is raised here.
    """
    threads = torch.get_num_threads()
    step = max(min_range, -(-rows // (threads * RANGES_PER_THREAD)))
    starts = range(0, rows, step)
    if threads == 1 or len(starts) <= 1:
        work(0, rows)
        return
    with ThreadPoolExecutor(threads) as pool:
        for future in [pool.submit(work, start, min(start + step, rows)) for start in starts]:
            future.result()
