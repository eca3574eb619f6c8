"""Faults of cameras, put into a recording: single bad frames, image losses, jumps to another place."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kiteline_bench.harness.recording import Item, Recording
from kiteline_core.arrays import U8, Bool
from kiteline_core.frame import Frame, ImuBatch, chosen, joined

Change = Callable[[Frame], Frame]
Fault = Callable[[Recording], Recording]
Spans = Sequence[tuple[float, float]]  # from and to, in s after the first frame

_WALL_GREY, _BLACK_GREY, _NEAR_GREY = 120.0, 6.0, 70
_NOISE_GREY = 1.3  # deviation of a camera's noise
_SMEAR_PX = 25
_GYRO, _STUCK = 3, 20  # axes of a gyro; samples that a stuck bus repeats
_MOST_RAD_S, _MOST_M_S2 = 15.0, 100.0  # that a bus with bit errors reads
_FIRST_KEPT = 3  # first frames of a flight that no chance changes


# changes of one frame


def images(change: Callable[[U8], NDArray[np.floating] | U8]) -> Change:
    """Apply a change to the left and the right image; grey values are clipped to 0..255."""

    def changed(image: U8) -> U8:
        return np.clip(change(image), 0, 255).astype(np.uint8)

    return lambda frame: replace(
        frame, left=changed(frame.left), right=None if frame.right is None else changed(frame.right), encoded=()
    )


def blank(grey: float) -> Change:
    """Show a plain surface of one grey value, with the camera's noise."""

    def change(frame: Frame) -> Frame:
        rng = np.random.default_rng([frame.t_ns, 5])
        return images(lambda image: grey + _NOISE_GREY * rng.standard_normal(image.shape))(frame)

    return change


def gain(factor: float, offset: float = 0.0) -> Change:
    """Change exposure and contrast."""
    return images(lambda image: image * factor + offset)


wall, black = blank(_WALL_GREY), blank(_BLACK_GREY)


def hidden(share: float, side: int) -> Change:
    """A dark surface out of focus close to the camera hides a share of the view. side: of 4, from which it comes."""

    def change(image: U8) -> U8:
        out, seen = np.full_like(image, _NEAR_GREY), np.rot90(image, side)
        begin = round(share * len(seen))
        np.rot90(out, side)[begin:] = seen[begin:]
        return out

    return images(change)


def torn(frame: Frame) -> Frame:
    """One of the images is shifted sideways below a row, by chance: a transfer lost some bytes."""
    rng = np.random.default_rng([frame.t_ns, 6])
    of_right, shift = frame.right is not None and rng.random() < 0.5, int(rng.choice((-1, 1)) * rng.integers(15, 60))
    image = frame.right if of_right and frame.right is not None else frame.left
    row = int(rng.uniform(0.2, 0.6) * len(image))
    broken = np.concatenate([image[:row], np.roll(image[row:], shift, axis=1)])
    return replace(frame, right=broken, encoded=()) if of_right else replace(frame, left=broken, encoded=())


def smeared(frame: Frame) -> Frame:
    """The camera was hit while it exposed: a line of 25 px along the rows instead of each point."""
    ends = (_SMEAR_PX - 1) // 2

    def change(image: U8) -> NDArray[np.floating]:
        sums = np.cumsum(np.pad(image.astype(np.float64), ((0, 0), (ends + 1, ends)), "edge"), axis=1)
        return (sums[:, _SMEAR_PX:] - sums[:, :-_SMEAR_PX]) / _SMEAR_PX

    return images(change)(frame)


def no_right(frame: Frame) -> Frame:
    """The frame without its right image."""
    return replace(frame, right=None)


def no_depth(frame: Frame) -> Frame:
    """The frame without any valid depth."""
    return replace(frame, depth_m=None if frame.depth_m is None else np.zeros_like(frame.depth_m))


# changes of a recording


def _each(recording: Recording, change: Callable[[int, Frame], Frame]) -> Recording:
    """Change each frame by its number."""
    items = (replace(item, frame=change(k, item.frame)) for k, item in enumerate(recording.items))
    return replace(recording, items=tuple(items))


def within(seconds: NDArray[np.floating], spans: Spans) -> Bool:
    """Mask (n,) of the times that lie in one of the spans."""
    inside = np.zeros(len(seconds), bool)
    for begin_s, end_s in spans:
        inside |= (seconds >= begin_s) & (seconds < end_s)
    return inside


def _each_batch(recording: Recording, change: Callable[[ImuBatch], ImuBatch | None]) -> Recording:
    """Change each batch of inertial samples; None: it is left out."""
    items = (replace(item, imu=None if item.imu is None else change(item.imu)) for item in recording.items)
    return replace(recording, items=tuple(items))


def changed(recording: Recording, begin: int, end: int, change: Change) -> Recording:
    """Change frames begin..end."""
    return _each(recording, lambda k, frame: change(frame) if begin <= k < end else frame)


def some(recording: Recording, share: float, change: Change, seed: int) -> Recording:
    """Change a share of all frames, drawn by chance; the first three are left."""
    drawn = np.random.default_rng(seed).random(len(recording.items)) < share
    return _each(recording, lambda k, frame: change(frame) if drawn[k] and k >= _FIRST_KEPT else frame)


def flickering(recording: Recording, deviation: float, seed: int) -> Recording:
    """Multiply each image by a factor of its own; deviation: of its natural logarithm. Bright parts are clipped."""
    factors = np.exp(np.random.default_rng(seed).normal(0.0, deviation, len(recording.items)))
    return _each(recording, lambda k, frame: gain(float(factors[k]))(frame))


def without_samples(recording: Recording, every_s: float, length_s: float) -> Recording:
    """Leave out the inertial samples of the last `length_s` of every `every_s`."""
    batches = [item.imu for item in recording.items if item.imu is not None]
    if not batches:
        return recording
    begin_ns = int(batches[0].t_ns[0])

    def kept(imu: ImuBatch) -> ImuBatch | None:
        keep = (imu.t_ns - begin_ns) * 1e-9 % every_s < every_s - length_s
        return chosen(imu, keep) if keep.any() else None

    return _each_batch(recording, kept)


def samples_between(recording: Recording, spans: Spans) -> Recording:
    """Leave out the inertial samples outside of these spans. The rig has an IMU all the same, if nothing is left."""
    first_ns = recording.items[0].frame.t_ns

    def kept(imu: ImuBatch) -> ImuBatch | None:
        keep = within((imu.t_ns - first_ns) * 1e-9, spans)
        return chosen(imu, keep) if keep.any() else None

    return _each_batch(recording, kept)


def samples_from(recording: Recording, begin_s: float) -> Recording:
    """Leave out the inertial samples of the first `begin_s`: an agent that runs before its flight controller."""
    return samples_between(recording, ((begin_s, np.inf),))


def dark_between(recording: Recording, spans: Spans) -> Recording:
    """Nothing is to be seen in the images of these spans; a depth camera measures on."""
    first_ns = recording.items[0].frame.t_ns
    dark = within(np.array([(item.frame.t_ns - first_ns) * 1e-9 for item in recording.items]), spans)
    return _each(recording, lambda k, frame: black(frame) if dark[k] else frame)


def hidden_at_times(recording: Recording, share: float, every_s: float, length_s: float, seed: int) -> Recording:
    """Something hides a share of the view for some seconds in every so many; when at first and from where by chance."""
    first_ns, rng = recording.items[0].frame.t_ns, np.random.default_rng(seed)
    begin_s, sides = float(rng.uniform(0.5, every_s)), rng.integers(4, size=len(recording.items))

    def change(_number: int, frame: Frame) -> Frame:
        times, since_s = divmod((frame.t_ns - first_ns) * 1e-9 - begin_s, every_s)
        return hidden(share, int(sides[int(times)]))(frame) if times >= 0 and since_s < length_s else frame

    return _each(recording, change)


def late_samples(recording: Recording, late_s: float) -> Recording:
    """Stamp the inertial samples late, so that a recording gives them after their frames; negative: early."""
    samples = _joined_imu(recording.items)
    if samples is None:
        return recording
    return recording.with_imu(replace(samples, t_ns=samples.t_ns + round(1e9 * late_s)))


def samples_in_bursts(recording: Recording, every_s: float) -> Recording:
    """Stamp the inertial samples when they arrive: all of some milliseconds together, 50 us apart."""
    every_ns, newest_ns = round(1e9 * every_s), -(1 << 62)

    def arrived(imu: ImuBatch) -> ImuBatch:
        nonlocal newest_ns
        stamps = []
        for t_ns in imu.t_ns.tolist():
            newest_ns = max(-(-t_ns // every_ns) * every_ns, newest_ns + 50_000)
            stamps.append(newest_ns)
        return replace(imu, t_ns=np.array(stamps, np.int64))

    return _each_batch(recording, arrived)


def wrong_samples(recording: Recording, share: float, seed: int) -> Recording:
    """Spoil inertial samples, beginning at a share of them: an axis reads anything, all read zero, or one is repeated.

    One in ten is repeated, twenty times, so that about three times the share is wrong.
    """
    samples = _joined_imu(recording.items)
    if samples is None:
        return recording
    rng, values = np.random.default_rng(seed), np.concatenate([samples.gyro, samples.accel], axis=1)
    for k in np.flatnonzero(rng.random(len(values)) < share).tolist():
        kind, axis = rng.choice(["peak", "zeros", "stuck"], p=[0.8, 0.1, 0.1]), int(rng.integers(6))
        if kind == "peak":
            values[k, axis] = rng.uniform(-1.0, 1.0) * (_MOST_RAD_S if axis < _GYRO else _MOST_M_S2)
        else:
            values[k : k + (1 if kind == "zeros" else _STUCK)] = 0.0 if kind == "zeros" else values[k]
    return recording.with_imu(ImuBatch(samples.t_ns, values[:, :_GYRO].copy(), values[:, _GYRO:].copy()))


def scattered_stamps(recording: Recording, deviation_s: float, seed: int) -> Recording:
    """Stamp each image by chance sooner or later than it was taken; true poses stay those of the images."""
    stamps = [item.frame.t_ns for item in recording.items]
    off_s = np.random.default_rng(seed).normal(0.0, deviation_s, len(stamps))
    new = np.maximum.accumulate(stamps + np.round(1e9 * off_s).astype(np.int64)) + np.arange(len(stamps))
    return _each(recording, lambda k, frame: replace(frame, t_ns=int(new[k])))


def stuck(recording: Recording, begin: int, end: int) -> Recording:
    """Repeat the image before frame `begin` until frame `end`."""
    last = recording.items[begin - 1].frame
    return changed(
        recording, begin, end,
        lambda frame: replace(frame, left=last.left, right=last.right, depth_m=last.depth_m, encoded=()),
    )  # fmt: skip


def every_nth(recording: Recording, begin: int, end: int, n: int) -> Recording:
    """Keep the last of every n frames in begin..end, with the inertial samples of all n."""
    items = recording.items
    kept = [replace(items[k + n - 1], imu=_joined_imu(items[k : k + n])) for k in range(begin, end, n)]
    return replace(recording, items=(*items[:begin], *kept, *items[end:]))


def rearranged(recording: Recording, order: Sequence[int | None]) -> Recording:
    """Frames in another order, at the same rate; None: a blank wall. No inertial samples: nobody flew that path.

    True poses go along; in front of the wall the camera stays where it was.
    """
    items, last, first_ns = [], 0, recording.items[0].frame.t_ns
    for k, source in enumerate(order):
        last = last if source is None else source
        item = recording.items[last]
        frame = replace(item.frame, t_ns=first_ns + k * recording.period_ns)
        items.append(Item(wall(frame) if source is None else frame, T_w_b=item.T_w_b))
    return replace(recording, imu=None, items=tuple(items))


def _joined_imu(items: Sequence[Item]) -> ImuBatch | None:
    return joined([item.imu for item in items if item.imu is not None])


# named faults


def _quarter(seconds: float, change: Change) -> Fault:
    """Change frames for some time after the first quarter; the last frame is left as it is."""

    def fault(recording: Recording) -> Recording:
        begin, last = len(recording.items) // 4, len(recording.items) - 1
        return changed(recording, begin, min(begin + round(seconds * 1e9 / recording.period_ns), last), change)

    return fault


def _reordered(order: Callable[[list[Item], int], list[Item]]) -> Fault:
    """Change the list of items at the first quarter."""
    return lambda recording: replace(
        recording, items=tuple(order(list(recording.items), len(recording.items) // 4))
    )  # fmt: skip


def _duplicated(items: list[Item], n: int) -> list[Item]:
    return [*items[:n], replace(items[n - 1], imu=None), *items[n:]]


CAMERA_FAULTS: dict[str, Fault] = {
    "dropped": _reordered(lambda items, n: items[:n] + items[n + 5 :]),
    "duplicated": _reordered(_duplicated),
    "out of order": _reordered(lambda items, n: [*items[:n], items[n + 1], items[n], *items[n + 2 :]]),
    "stuck": lambda r: stuck(r, len(r.items) // 4, len(r.items) // 4 + 5),
    "black": _quarter(0.15, black),
    "no right image": _quarter(0.5, no_right),
    "no depth": _quarter(0.5, no_depth),
    "exposure jump": _quarter(0.5, gain(1.5)),
    "covered lens, 2 s": _quarter(2.0, black),
    "no texture, 10 s": _quarter(10.0, wall),
}  # after a quarter of the recording


def camera_faults_of(recording: Recording) -> dict[str, Fault]:
    """The faults that a recording's cameras can have."""
    missing = set()
    if recording.rig.right is None:
        missing.add("no right image")
    if not recording.rig.has_depth:
        missing.add("no depth")
    return {name: fault for name, fault in CAMERA_FAULTS.items() if name not in missing}


def _middle(count: int, change: Change, first: int = 0) -> Fault:
    """Change `count` frames that begin `first` frames after the middle."""

    def fault(recording: Recording) -> Recording:
        begin = len(recording.items) // 2 + first
        return changed(recording, begin, begin + count, change)

    return fault


def _kidnapped(recording: Recording) -> Recording:
    """A blank wall, then on at the place that is reached a second and a half later."""
    n = len(recording.items) // 2
    items = _middle(6, wall, -6)(recording).items
    there = replace(recording.items[n + 30], imu=_joined_imu(recording.items[n : n + 31]))
    return replace(recording, items=(*items[:n], there, *recording.items[n + 31 :]))


def _middle_of(fault: Callable[[Recording, int, int], Recording], count: int) -> Fault:
    return lambda recording: fault(recording, len(recording.items) // 2, len(recording.items) // 2 + count)


FAULTS_IN_MID_FLIGHT: dict[str, Fault] = {
    "none": lambda recording: recording,
    "black, 0.3 s": _middle(6, black),
    "black, 2 s": _middle(40, black),
    "blank wall, 1.5 s": _middle(30, wall),
    "no contrast, 1 s": _middle(20, gain(0.03, 100.0)),
    "too bright, 1 s": _middle(20, gain(2.4)),
    "too dark, 1 s": _middle(20, gain(0.15)),
    "left image only, 1 s": _middle(20, no_right),
    "stuck, 0.6 s": _middle_of(stuck, 12),
    "four times as fast": _middle_of(lambda r, begin, end: every_nth(r, begin, end, 4), 32),
    "out at another place": _kidnapped,
    "two walls": lambda recording: _middle(14, wall, 28)(_middle(14, wall)(recording)),
}  # in the middle of a flight at 20 Hz
