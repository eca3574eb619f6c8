"""Predicted projections of landmarks into a keyframe, from values of the agent. See SPEC.md, "Predicted".

Only + - * / and comparisons of IEEE doubles, each rounded by itself and in the order written here, so that both sides
get the same integers on any machine.
"""

from kiteline_core.arrays import F64, I32, I64
from kiteline_core.jit import njit

_PIXEL_STEPS = 16.0
_PIXEL_ORIGIN = -64.0
_PIXEL_CODES = 1 << 16
_MANTISSA = 1024
_DEPTH_CODES = 13 * _MANTISSA
_DEPTH_SCALE = 0.0078125
_LEAST_DEPTH = 0.05  # of the landmark's depth: nearer to the camera than that, it is not predicted


@njit
def compose(a: F64, b: F64, out: F64) -> None:
    """out (4,4) = a @ b for rigid motions."""
    for i in range(3):
        for j in range(4):
            v = a[i, 0] * b[0, j]
            v = v + a[i, 1] * b[1, j]
            v = v + a[i, 2] * b[2, j]
            out[i, j] = v + a[i, 3] if j == 3 else v
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@njit
def invert(a: F64, out: F64) -> None:
    """out (4,4) = inverse of a rigid motion."""
    for i in range(3):
        v = a[0, i] * a[0, 3]
        v = v + a[1, i] * a[1, 3]
        v = v + a[2, i] * a[2, 3]
        for j in range(3):
            out[i, j] = a[j, i]
        out[i, 3] = -v
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@njit
def _inverse_depth(code: int) -> float:
    e, m = code // _MANTISSA, code % _MANTISSA
    return (float(_MANTISSA + m) * float(1 << e) / _MANTISSA - 1.0) * _DEPTH_SCALE


@njit
def select(landmarks: I32, keypoint: I64, mask: int, first: int, out: I64) -> None:
    """Codes of the landmarks at keypoints (n,) whose part is in the mask into columns `first` on of `out` (4, m).

    Elsewhere `out` is left as it is. landmarks: (5, k) codes of u, v, inverse depth and octave by keypoint, and the
    part, -1 where there is none.
    """
    for i in range(keypoint.size):
        at = keypoint[i]
        if at >= landmarks.shape[1]:
            continue
        part = landmarks[4, at]
        if part >= 0 and (mask >> part) & 1 == 1:
            for k in range(4):
                out[k, first + i] = landmarks[k, at]


@njit
def predict(codes: I64, place: I64, T_k_a: F64, camera: F64, out: I64) -> None:
    """Codes of u, v and inverse depth (3, n) of landmarks projected into keyframe k; -1 where there is no prediction.

    codes: (3 or more, n) of u, v and inverse depth in the landmark's keyframe a, -1 where unknown. place: (n,) rows of
    T_k_a (m,4,4). camera: fx, fy, cx, cy.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    for i in range(place.size):
        out[0, i] = out[1, i] = out[2, i] = -1
        if codes[0, i] < 0 or codes[2, i] == 0:
            continue
        T = T_k_a[place[i]]
        rho = _inverse_depth(int(codes[2, i]))
        x = (float(codes[0, i]) / _PIXEL_STEPS + _PIXEL_ORIGIN - cx) / fx
        y = (float(codes[1, i]) / _PIXEL_STEPS + _PIXEL_ORIGIN - cy) / fy
        px = T[0, 0] * x
        px = px + T[0, 1] * y
        px = px + T[0, 2]
        px = px + T[0, 3] * rho
        py = T[1, 0] * x
        py = py + T[1, 1] * y
        py = py + T[1, 2]
        py = py + T[1, 3] * rho
        pz = T[2, 0] * x
        pz = pz + T[2, 1] * y
        pz = pz + T[2, 2]
        pz = pz + T[2, 3] * rho
        if not pz > _LEAST_DEPTH:
            continue
        a = (px / pz * fx + cx - _PIXEL_ORIGIN) * _PIXEL_STEPS + 0.5
        b = (py / pz * fy + cy - _PIXEL_ORIGIN) * _PIXEL_STEPS + 0.5
        if not (a >= 0.0 and a < _PIXEL_CODES and b >= 0.0 and b < _PIXEL_CODES):
            continue
        w = rho / pz / _DEPTH_SCALE + 1.0
        e = 0
        while w >= 2.0 and e < 13:
            w = w * 0.5
            e += 1
        code = e * _MANTISSA + int((w - 1.0) * _MANTISSA + 0.5)
        out[0, i], out[1, i] = int(a), int(b)
        out[2, i] = min(max(code, 1), _DEPTH_CODES - 1)
