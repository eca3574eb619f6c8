"""The refined path of an agent: its frames, placed by the base's keyframes."""

from collections.abc import Iterator, Mapping, Sequence

from kiteline_agent.step import Estimate
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3, sim3


def refined_path(frames: Sequence[Estimate], T_w_k: Mapping[int, F64], T_b_c: F64) -> list[tuple[int, F64]]:
    """Poses (t_ns, T_w_b) of all tracked frames in w, in order of time.

    T_w_k: the base's keyframe poses (camera in w), scaled where the agent's unit of length differs from that of w.
    Where the base moved the next keyframe relative to this one, the frames between take a share of that correction that
    grows with time, so that the path has no step at the change of keyframe. A frame whose keyframe the base does not
    hold (not received before the flight ended) is placed by its submap, and the submap by the nearest earlier keyframe
    that the base holds, or else by the first one. Frames of submaps without such keyframes are left out.
    """
    poses: list[tuple[int, F64]] = []
    placed: dict[int, F64] = {}  # submap -> S_w_m that its latest known keyframe implies
    waiting: dict[int, list[tuple[int, F64]]] = {}
    T_c_b = se3.inverse(T_b_c)
    for run, correction in _runs(frames, T_w_k, T_b_c):
        begin_ns = run[0].t_ns
        for frame in run:
            assert frame.T_m_b is not None
            submap = int(frame.submap)
            known = T_w_k.get(int(frame.keyframe))
            if known is not None:
                if correction is not None:
                    known = known @ se3.exp((frame.t_ns - begin_ns) / (correction[0] - begin_ns) * correction[1])
                S_w_c = known @ frame.T_k_c
                placed[submap] = sim3.normalise(S_w_c @ se3.inverse(frame.T_m_b @ T_b_c))
                early = waiting.pop(submap, ())
                poses.extend((t_ns, placed[submap] @ T_m_c) for t_ns, T_m_c in early)
                poses.append((frame.t_ns, S_w_c))
            elif submap in placed:
                poses.append((frame.t_ns, placed[submap] @ frame.T_m_b @ T_b_c))
            else:
                waiting.setdefault(submap, []).append((frame.t_ns, frame.T_m_b @ T_b_c))
    poses.sort(key=lambda pose: pose[0])
    # The offset from camera to body is in metres, whatever the unit of the map.
    return [(t_ns, se3.orthonormalise(sim3.rigid(S_w_c) @ T_c_b)) for t_ns, S_w_c in poses]


def _runs(
    frames: Sequence[Estimate], T_w_k: Mapping[int, F64], T_b_c: F64
) -> Iterator[tuple[list[Estimate], tuple[int, F64] | None]]:
    """Consecutive tracked frames with one reference keyframe, and the correction at the next keyframe.

    The correction is (time of the next keyframe, tangent vector (6,)); None where no new keyframe ends the run.
    """
    run: list[Estimate] = []
    seen: set[int] = set()
    for frame in frames:
        if not frame.tracked or frame.T_m_b is None:
            if run:
                yield run, None
            run = []
            continue
        if run and frame.keyframe != run[-1].keyframe:
            is_new = int(frame.keyframe) not in seen and frame.submap == run[-1].submap
            yield run, (_correction(run[-1], frame, T_w_k, T_b_c) if is_new else None)
            run = []
        seen.add(int(frame.keyframe))
        run.append(frame)
    if run:
        yield run, None


def _correction(last: Estimate, first: Estimate, T_w_k: Mapping[int, F64], T_b_c: F64) -> tuple[int, F64] | None:
    """How the base moved the next keyframe. last: last frame on the old keyframe. first: the next keyframe's frame."""
    old, new = T_w_k.get(int(last.keyframe)), T_w_k.get(int(first.keyframe))
    if old is None or new is None:
        return None
    step = se3.inverse(last.T_o_b @ T_b_c) @ first.T_o_b @ T_b_c  # of the camera, by the agent's odometry
    change = sim3.inverse(old) @ new @ first.T_k_c @ se3.inverse(last.T_k_c @ step)
    return first.t_ns, se3.log(sim3.rigid(change))
