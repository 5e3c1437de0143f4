"""Times of a bag's messages brought together, readings between them, and the stops of a turntable. Pure computation.

Messages have up to two times: the stamp that the sensor's driver gave, and the time at which the recorder received
them. Stamps are better where all of them come from one clock. Where they do not, or one topic has none, all are
brought to the recorder's clock: a message is never received before it was sent, so the shortest delays of a topic show
how its clock and the recorder's differ.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Set
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import BoolArray, FloatArray

_PARTS = 6
_CLOCK_TOLERANCE_S = 0.1
"""How far the shortest delays of a topic may wander before its clock is called unusable."""
_MAX_DRIFT = 1e-3
_GAP_FACTOR = 5.0
_LOOSE_S = 3600.0


@dataclass(frozen=True, eq=False)
class Stream:
    """Times (N,) in seconds of a topic's messages; `stamp_s` is None unless every message has one."""

    received_s: FloatArray
    stamp_s: FloatArray | None

    @staticmethod
    def of(received_ns: list[int], stamps_ns: list[int | None]) -> Stream:
        stamps = np.array([np.nan if s is None else s * 1e-9 for s in stamps_ns])
        known = len(stamps) > 0 and bool(np.isfinite(stamps).all())
        return Stream(np.array(received_ns, dtype=np.float64) * 1e-9, stamps if known else None)


def common_times(
    where: str, streams: Mapping[str, Stream], loose: Set[str] = frozenset()
) -> tuple[dict[str, FloatArray], list[str]]:
    """Times (N,) of each stream by one clock, and remarks on how they were had.

    Streams named in `loose` (images of the board, taken before the scans) need not overlap the others; an hour apart,
    they too are of another clock.

    Raises
    ------
    InputError
        If stamps run backwards, a clock wanders against the recorder's, or two streams have no time in common.
    """
    for name, stream in streams.items():
        if stream.stamp_s is not None and np.any(np.diff(stream.stamp_s) < 0.0):
            index = int(np.argmax(np.diff(stream.stamp_s) < 0.0)) + 1
            raise InputError(
                where,
                f"the stamps run backwards at message {index + 1}",
                field=name,
                expected="stamps in the order of recording",
                remedy="The sensor's clock was set while recording; record again.",
            )
    stamps = {name: stream.stamp_s for name, stream in streams.items() if stream.stamp_s is not None}
    if len(stamps) == len(streams) and _all_meet(stamps, loose):
        return dict(stamps), []
    remarks: list[str] = []
    times = {name: _recorder_time(where, name, stream, remarks) for name, stream in streams.items()}
    if not _all_meet(times, loose):
        spans = "; ".join(f"{name} {t[0]:.3f} to {t[-1]:.3f} s" for name, t in times.items())
        raise InputError(
            where,
            f"the topics' time stamps cannot be brought together: {spans}",
            expected="topics that were recorded at the same time",
        )
    return times, remarks


def _all_meet(times: Mapping[str, FloatArray], loose: Set[str]) -> bool:
    slack = {name: _LOOSE_S if name in loose else 0.0 for name in times}
    latest_start = max(float(t[0]) - slack[name] for name, t in times.items())
    return latest_start <= min(float(t[-1]) + slack[name] for name, t in times.items())


def _recorder_time(where: str, name: str, stream: Stream, remarks: list[str]) -> FloatArray:
    if stream.stamp_s is None:
        remarks.append(f"{name} has no stamps: the times of reception stand for them, late by an unknown delay.")
        return np.maximum.accumulate(stream.received_s)
    lag = stream.received_s - stream.stamp_s
    start = float(stream.stamp_s[0])
    edges = np.linspace(0, len(lag), _PARTS + 1).astype(int) if len(lag) >= 5 * _PARTS else np.array([0, len(lag)])
    parts = [slice(a, b) for a, b in pairwise(edges)]
    shortest = np.array([lag[part].min() for part in parts])
    when = np.array([stream.stamp_s[part][int(np.argmin(lag[part]))] - start for part in parts])
    offset = np.full(len(lag), lag.min())
    if np.ptp(shortest) > _CLOCK_TOLERANCE_S:
        slope, level = np.polyfit(when, shortest - shortest[0], 1)
        misfit = np.ptp(shortest - shortest[0] - slope * when - level)
        if abs(slope) > _MAX_DRIFT or misfit > _CLOCK_TOLERANCE_S:
            raise InputError(
                where,
                f"its clock cannot be brought together with the recorder's: even the shortest delays differ by "
                f"{np.ptp(shortest):.2f} s within the recording",
                field=name,
                expected="stamps of one steady clock",
                remedy="Synchronise the sensor's clock, or let its driver stamp by the computer's.",
            )
        line = slope * (stream.stamp_s - start)
        offset = line + (lag - line).min()
    typical = float(np.median(lag - offset))
    remarks.append(
        f"{name} is stamped by another clock than the other topics: brought to the recorder's by its shortest delay "
        f"(offset {offset[0]:.4f} s, delays mostly {1e3 * typical:.0f} ms beyond that)."
    )
    return np.asarray(stream.stamp_s + offset)


def continuous_deg(reading_deg: FloatArray) -> FloatArray:
    """Readings (K,) that pass from 359 to 0 made continuous: steps of more than half a turn are taken the short way."""
    return np.unwrap(reading_deg, period=360.0)


def interpolate(time_s: FloatArray, reading_deg: FloatArray, wanted_s: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Readings at other times (...), and where they are known: between two readings that stand close in time.

    A gap is too long at five times the usual one, unless the reading is the same before and after it.
    """
    time, first = np.unique(time_s, return_index=True)
    reading = continuous_deg(reading_deg)[first]
    if len(time) < 2:
        return np.full(np.shape(wanted_s), reading[0]), np.asarray(wanted_s) == time[0]
    angle = np.interp(wanted_s, time, reading)
    after = np.clip(np.searchsorted(time, wanted_s), 1, len(time) - 1)
    gap = np.diff(time)
    good = (gap <= _GAP_FACTOR * np.median(gap)) | (np.diff(reading) == 0.0)
    inside = (np.asarray(wanted_s) >= time[0]) & (np.asarray(wanted_s) <= time[-1])
    return angle, inside & good[after - 1]


@dataclass(frozen=True)
class Dwell:
    """A stop of the turntable."""

    start_s: float
    end_s: float
    reading_deg: float


def find_dwells(time_s: FloatArray, reading_deg: FloatArray, *, tolerance_deg: float, least_s: float) -> list[Dwell]:
    """The longest intervals, from the first on, in which readings stay within `tolerance_deg` for `least_s` or more."""
    reading = continuous_deg(reading_deg)
    highest: deque[int] = deque()
    lowest: deque[int] = deque()
    dwells: list[Dwell] = []
    start = 0

    def close(end: int) -> None:
        if end > start and time_s[end] - time_s[start] >= least_s:
            mean = float(np.mean(reading[start : end + 1]))
            dwells.append(Dwell(float(time_s[start]), float(time_s[end]), mean))
            highest.clear()
            lowest.clear()

    for k, value in enumerate(reading):
        for queue, sign in ((highest, 1.0), (lowest, -1.0)):
            while queue and sign * reading[queue[-1]] <= sign * value:
                queue.pop()
            queue.append(k)
        if reading[highest[0]] - reading[lowest[0]] <= tolerance_deg:
            continue
        if time_s[k - 1] - time_s[start] >= least_s:
            close(k - 1)
            start = k
            highest.append(k)
            lowest.append(k)
            continue
        while reading[highest[0]] - reading[lowest[0]] > tolerance_deg:
            start += 1
            for queue in (highest, lowest):
                while queue[0] < start:
                    queue.popleft()
    if len(reading):
        close(len(reading) - 1)
    return dwells
