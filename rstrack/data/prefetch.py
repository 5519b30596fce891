"""Loading ahead of the consumer in a thread, so that decoding overlaps tracking."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


def prefetched(load: Callable[[Key], Value], keys: Iterable[Key], ahead: int) -> Iterator[Value]:
    """load(key) of each key, in order; up to `ahead` (at least 1) are loaded in a thread while the last one is used.

    What `load` raises is raised here, in its turn. The thread has ended once the iterator is exhausted, closed or
    dropped, or has raised.
    """
    remaining = iter(keys)
    executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="prefetch")
    try:
        waiting: deque[Future[Value]] = deque()

        def load_next() -> None:
            for key in remaining:
                waiting.append(executor.submit(load, key))
                return

        for _ in range(max(1, ahead)):
            load_next()
        while waiting:
            value = waiting.popleft().result()
            load_next()
            yield value
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
