"""Where several processes test at once, each has its share of the cores."""

from __future__ import annotations

import os


def pytest_configure() -> None:
    """Dr.Jit's threads wait for work busily: two processes with all cores each are half as fast as with half each."""
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    if workers > 1:
        from rsgen.device.backend import select

        select()
        import drjit

        drjit.set_thread_count(max(1, len(os.sched_getaffinity(0)) // workers))
