"""Rules by which tracks live on, and come back."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from predmapnet.config.section import Fraction, Metres, Positive, Section


class TrackingConfig(Section):
    """Rules by which rows live on (Sec. 3.1) and tracks and detections of one instance become one row.

    Attributes:
        tau_d: a detection scored above it is born as a track.
        first_tau_d: the same in the first frame of a stream; ``tau_d`` by default.
        tau_t: a track scored above it is supported; others count a miss.
        misses_allowed: consecutive misses after which a track ends is one more than this; 0 is the paper's scheme.
        merge: merge tracks with detections and with each other.
        merge_distance: chamfer distance in metres of a track and a detection of one instance.
        duplicate_distance: chamfer distance in metres of two tracks of one instance; the older id stays.
        merge_samples: points per line for these distances.
        report_threshold: rows scored below are not reported at all.
    """

    tau_d: Fraction = 0.5
    first_tau_d: Fraction | None = None
    tau_t: Fraction = 0.3
    misses_allowed: Annotated[int, Field(ge=0)] = 6
    merge: bool = True
    merge_distance: Metres = 2.0
    duplicate_distance: Metres = 1.5
    merge_samples: Annotated[int, Field(ge=2, le=1_000)] = 50
    report_threshold: Fraction = 0.05


class RevivalConfig(Section):
    """Lost tracks that may come back, which the paper does not have.

    Attributes:
        enabled: switch.
        frames: k; how many frames a track may go unseen and still get its id back.
        distance: chamfer distance in metres of a lost track and a newborn one, where both could be seen.
        capacity: lost tracks remembered per stream; those that are missing for longest make room.
    """

    enabled: bool = True
    frames: Positive = 10
    distance: Metres = 2.5
    capacity: Positive = 32
