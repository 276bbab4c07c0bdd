"""Selection of lidar sweeps as frames, as in the published vector-map benchmarks on Argoverse 2.

They keep every fourth sweep of 10 Hz, but count across logs, so a log's first frame depends on all logs before it.
These rules need whole splits; a single log is read by the simple rule (its sweeps 0, 4, 8, ...) unless asked otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from mapfusion.arrays import Integer

IMAGE_TOLERANCE = 25_000_000
"""An image belongs to a sweep if it lies within half the cameras' shutter interval, nanoseconds."""


def sweeps_with_images(sweeps: Integer, images: Iterable[Integer]) -> Integer:
    """Return the time stamps of sweeps for which every camera has an image within 25 ms, in order.

    Args:
        sweeps: ``(n,)``, nanoseconds.
        images: per camera ``(k,)`` ascending time stamps of its images.
    """
    kept = np.ones(len(sweeps), dtype=bool)
    for times in images:
        if len(times) == 0:
            return sweeps[:0]
        after = np.searchsorted(times, sweeps)
        later, earlier = times[after.clip(max=len(times) - 1)], times[(after - 1).clip(min=0)]
        nearest = np.minimum(np.abs(later - sweeps), np.abs(earlier - sweeps))
        kept &= nearest <= IMAGE_TOLERANCE
    return sweeps[kept]


def strided_over_logs(sweeps: Mapping[str, Integer], stride: int) -> dict[str, Integer]:
    """Take every ``stride``-th sweep of all logs one after the other: the rule of the new split.

    Ascending time stamps by log come and go in the order of the split list; a short log may keep none.
    """
    frames = {}
    before = 0
    for log, times in sweeps.items():
        frames[log] = times[-before % stride :: stride]
        before += len(times)
    return frames


def strided_over_time(sweeps: Mapping[str, Integer], stride: int) -> dict[str, Integer]:
    """Take every ``stride``-th sweep of all logs sorted together by time: the rule of the old training split.

    Logs that were recorded at the same time interleave, so that steps inside a log may be uneven. Logs come in the
    order in which they first appear.
    """
    logs = list(sweeps)
    times = np.concatenate([np.zeros(0, dtype=np.int64), *sweeps.values()])
    owners = np.repeat(np.arange(len(logs)), [len(sweeps[log]) for log in logs])
    order = np.argsort(times, kind="stable")[::stride]
    return {logs[owner]: times[order[owners[order] == owner]] for owner in dict.fromkeys(owners[order].tolist())}
