"""Many sequences, each a job of its own, on workers: scene by scene, so that each is loaded and lit once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar

from rsgen.console.progress import Progress
from rsgen.console.scheduler import Workers


class SceneJob(Protocol):
    """A sequence to make. key: of what scene and light are made from; folder: there once the sequence is whole."""

    @property
    def key(self) -> str: ...


Job = TypeVar("Job", bound=SceneJob)
Result = TypeVar("Result")


def by_scene(
    function: Callable[[Job, Progress], Result], jobs: Sequence[Job], workers: Workers, progress: Progress
) -> Iterator[tuple[Job, Result]]:
    """Yield each job with function(job, progress), in any order. Raises what a job raises, and as `Workers.apply`.

    The first one of each scene alone: it bakes the light, if need be, and the others find it in the cache.
    """
    first = {job.key: k for k, job in reversed(list(enumerate(jobs)))}
    ahead = [job for k, job in enumerate(jobs) if first[job.key] == k]
    rest = sorted((job for k, job in enumerate(jobs) if first[job.key] != k), key=lambda job: job.key)
    for part in (ahead, rest):
        for k, result in workers.apply(function, part, progress):
            yield part[k], result
