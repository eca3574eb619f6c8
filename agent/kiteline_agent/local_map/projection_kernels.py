"""Projection of landmarks into a camera, choice of those to search, and depth updates from observations."""

import numpy as np

from kiteline_core.jit import helper, njit

_IN_FRONT = 0.1  # distance to a plane over that from the keyframe, above which its disparities are told


@helper
def _relative(T_c_m, T_m_k, r, t):  # type: ignore[no-untyped-def]
    """Write rotation r (3,3) and translation t (3,) from a keyframe at T_m_k (4,4) to a camera at T_c_m (4,4)."""
    for a in range(3):
        t[a] = T_c_m[a, 3]
        for m in range(3):
            t[a] += T_c_m[a, m] * T_m_k[m, 3]
        for b in range(3):
            v = 0.0
            for m in range(3):
                v += T_c_m[a, m] * T_m_k[m, b]
            r[a, b] = v


@njit
def project(  # type: ignore[no-untyped-def]
    T_c_m,
    camera,
    size,
    margin_px,
    max_scale,
    slots,
    T_m_k,
    order,
    counts,
    usable,
    bearing,
    rho,
    slant,
    sigma_rho,
    out_row,
    out_uv,
    out_warp,
    out_xyz,
    out_ray,
    out_depth,
):
    """Project the usable landmarks of keyframe slots into a camera.

    T_c_m: (4,4). camera: fx, fy, cx, cy, bf. size: width, height px. slots: (s,) int64. T_m_k: (K,4,4). order: (K,B)
    int64, landmarks of a slot in the order in which they are taken. counts: (K,). usable: (K,B) bool. bearing: (K,B,2)
    x/z, y/z in the keyframe. rho, sigma_rho: (K,B) inverse depth, its deviation, 1/m. slant: (K,B,2) gradient of the
    logarithm of inverse depth by the bearing, of the surface around the landmark.
    Out, capacity K*B: out_row slot*B+index, out_uv px, out_warp (2,2) d(px here)/d(px in the keyframe), out_xyz
    m in the submap frame, out_ray m (one deviation of depth as a vector), out_depth m. Returns how many were written.
    """
    fx, fy, cx, cy = camera[0], camera[1], camera[2], camera[3]
    slot_size = usable.shape[1]
    n = 0
    step = 4.0
    r, t = np.empty((3, 3)), np.empty(3)
    for s in range(slots.shape[0]):
        k = slots[s]
        _relative(T_c_m, T_m_k[k], r, t)
        for j in range(counts[k]):
            i = order[k, j]
            if not usable[k, i]:
                continue
            bx, by, p = bearing[k, i, 0], bearing[k, i, 1], rho[k, i]
            x = r[0, 0] * bx + r[0, 1] * by + r[0, 2] + t[0] * p
            y = r[1, 0] * bx + r[1, 1] * by + r[1, 2] + t[1] * p
            z = r[2, 0] * bx + r[2, 1] * by + r[2, 2] + t[2] * p
            if z < 0.05 or z < 0.1 * p:
                continue
            u = fx * x / z + cx
            v = fy * y / z + cy
            if u < margin_px or v < margin_px or u >= size[0] - margin_px or v >= size[1] - margin_px:
                continue
            gx, gy = p * slant[k, i, 0], p * slant[k, i, 1]  # of the inverse depth
            x1, x2 = x + (r[0, 0] + t[0] * gx) * step / fx, x + (r[0, 1] + t[0] * gy) * step / fy
            y1, y2 = y + (r[1, 0] + t[1] * gx) * step / fx, y + (r[1, 1] + t[1] * gy) * step / fy
            z1, z2 = z + (r[2, 0] + t[2] * gx) * step / fx, z + (r[2, 1] + t[2] * gy) * step / fy
            if z1 < 0.05 or z2 < 0.05:
                continue
            a00 = (fx * x1 / z1 + cx - u) / step
            a10 = (fy * y1 / z1 + cy - v) / step
            a01 = (fx * x2 / z2 + cx - u) / step
            a11 = (fy * y2 / z2 + cy - v) / step
            det = a00 * a11 - a01 * a10
            if not (det >= 1.0 / (max_scale * max_scale) and det <= max_scale * max_scale):  # nor if it is no number
                continue
            out_row[n] = k * slot_size + i
            out_uv[n, 0] = u
            out_uv[n, 1] = v
            out_warp[n, 0, 0] = a00
            out_warp[n, 0, 1] = a01
            out_warp[n, 1, 0] = a10
            out_warp[n, 1, 1] = a11
            depth = 1.0 / p
            far = sigma_rho[k, i] * depth * depth  # d(1/rho) = d(rho) / rho^2
            for a in range(3):
                ray = T_m_k[k, a, 0] * bx + T_m_k[k, a, 1] * by + T_m_k[k, a, 2]
                out_xyz[n, a] = T_m_k[k, a, 3] + ray * depth
                out_ray[n, a] = ray * far
            out_depth[n] = z * depth
            n += 1
    return n


@njit
def views(T_c_m, camera, rows, T_m_k, bearing, rho, slant, warp, parallax):  # type: ignore[no-untyped-def]
    """How a camera sees the surfaces around landmarks, for the arguments see `project`.

    rows: (n,) slot*B+index. warp: (n,2,2) d(px here)/d(px in the keyframe), out. parallax: (n,2) px, derivative of the
    pixel here by the logarithm of inverse depth, out.
    """
    fx, fy = camera[0], camera[1]
    slot_size = rho.shape[1]
    r, t = np.empty((3, 3)), np.empty(3)
    for j in range(rows.shape[0]):
        k, i = rows[j] // slot_size, rows[j] % slot_size
        _relative(T_c_m, T_m_k[k], r, t)
        bx, by, p = bearing[k, i, 0], bearing[k, i, 1], rho[k, i]
        inv = 1.0 / max(r[2, 0] * bx + r[2, 1] * by + r[2, 2] + t[2] * p, 1e-3)
        x = (r[0, 0] * bx + r[0, 1] * by + r[0, 2] + t[0] * p) * inv
        y = (r[1, 0] * bx + r[1, 1] * by + r[1, 2] + t[1] * p) * inv
        px, py = (t[0] - x * t[2]) * inv * p, (t[1] - y * t[2]) * inv * p
        parallax[j, 0], parallax[j, 1] = fx * px, fy * py
        s0, s1 = slant[k, i, 0], slant[k, i, 1]
        warp[j, 0, 0] = (r[0, 0] - x * r[2, 0]) * inv + px * s0
        warp[j, 0, 1] = ((r[0, 1] - x * r[2, 1]) * inv + px * s1) * fx / fy
        warp[j, 1, 0] = ((r[1, 0] - y * r[2, 0]) * inv + py * s0) * fy / fx
        warp[j, 1, 1] = (r[1, 1] - y * r[2, 1]) * inv + py * s1


@njit
def disparity_slopes(T_c_m, camera, rows, T_m_k, bearing, rho, slant, limit, slopes):  # type: ignore[no-untyped-def]
    """Gradients (n,2) of the disparity by the pixel around landmarks in a camera, out; at most `limit`.

    For the arguments see `views`. The plane n X = 1 in the keyframe, whose inverse depths are n (x/z, y/z, 1), is
    n R^T X = 1 + n R^T t in the camera. Zero where the camera is nearly in such a plane, or behind it.
    """
    slot_size = rho.shape[1]
    r, t = np.empty((3, 3)), np.empty(3)
    for j in range(rows.shape[0]):
        k, i = rows[j] // slot_size, rows[j] % slot_size
        _relative(T_c_m, T_m_k[k], r, t)
        p, s0, s1 = rho[k, i], slant[k, i, 0], slant[k, i, 1]
        n0, n1, n2 = p * s0, p * s1, p * (1.0 - s0 * bearing[k, i, 0] - s1 * bearing[k, i, 1])
        c0 = r[0, 0] * n0 + r[0, 1] * n1 + r[0, 2] * n2
        c1 = r[1, 0] * n0 + r[1, 1] * n1 + r[1, 2] * n2
        c2 = r[2, 0] * n0 + r[2, 1] * n1 + r[2, 2] * n2
        away = 1.0 + c0 * t[0] + c1 * t[1] + c2 * t[2]
        slopes[j, 0] = slopes[j, 1] = 0.0
        if away > _IN_FRONT:
            slopes[j, 0] = min(max(camera[4] * c0 / (away * camera[0]), -limit), limit)
            slopes[j, 1] = min(max(camera[4] * c1 / (away * camera[1]), -limit), limit)


@njit
def select(order, first, uv, cell_px, limit, per_cell, cells, chosen):  # type: ignore[no-untyped-def]
    """Take candidates in `order`, at most per_cell a cell and `limit` in all. cells: (rows, columns) int32, in and out.

    first: (n,) bool, those that are taken before the others. chosen: (limit,) int64 out. Returns how many were chosen.
    """
    n = 0
    for others in range(2):
        for j in range(order.shape[0]):
            i = order[j]
            if n >= limit:
                return n
            if first[i] == (others == 1):
                continue
            r = int(uv[i, 1] / cell_px)
            c = int(uv[i, 0] / cell_px)
            if r < 0 or c < 0 or r >= cells.shape[0] or c >= cells.shape[1] or cells[r, c] >= per_cell:
                continue
            cells[r, c] += 1
            chosen[n] = i
            n += 1
    return n


@njit
def update_depths(T_c_m, camera, rows, inlier, observed, sigma_px, inflate, floor_rho, T_m_k, bearing, rho, sigma_rho):  # type: ignore[no-untyped-def]
    """Scalar Kalman update of inverse depths by observations, with the pose held fixed.

    rows: (n,) slot*B+index. observed: (n,3) u, v, disparity px (< 0: none). sigma_px: (n,). inflate: factor on the
    variance of an observation, for the pose's error and errors that successive observations share. rho, sigma_rho:
    in, out.
    """
    fx, fy, cx, cy, bf = camera[0], camera[1], camera[2], camera[3], camera[4]
    slot_size = rho.shape[1]
    for j in range(rows.shape[0]):
        if not inlier[j]:
            continue
        k = rows[j] // slot_size
        i = rows[j] % slot_size
        if sigma_rho[k, i] <= floor_rho:
            continue
        p = rho[k, i]
        bx, by = bearing[k, i, 0], bearing[k, i, 1]
        d = np.empty(3)
        t = np.empty(3)
        for a in range(3):
            t[a] = T_c_m[a, 3]
            d[a] = 0.0
            for m in range(3):
                t[a] += T_c_m[a, m] * T_m_k[k, m, 3]
                d[a] += T_c_m[a, m] * (T_m_k[k, m, 0] * bx + T_m_k[k, m, 1] * by + T_m_k[k, m, 2])
        x, y, z = d[0] + t[0] * p, d[1] + t[1] * p, d[2] + t[2] * p
        if z < 1e-3:
            continue
        iz = 1.0 / z
        ju = fx * (t[0] - x * iz * t[2]) * iz
        jv = fy * (t[1] - y * iz * t[2]) * iz
        variance = sigma_px[j] * sigma_px[j] * inflate
        info = (ju * ju + jv * jv) / variance
        grad = (ju * (observed[j, 0] - fx * x * iz - cx) + jv * (observed[j, 1] - fy * y * iz - cy)) / variance
        if observed[j, 2] >= 0.0:  # disparity = bf * p / z
            jd = bf * iz * (1.0 - p * t[2] * iz)
            info += jd * jd / variance
            grad += jd * (observed[j, 2] - bf * p * iz) / variance
        prior = 1.0 / (sigma_rho[k, i] * sigma_rho[k, i])
        total = prior + info
        new = p + grad / total
        if new > 0.2 * p and new < 5.0 * p:
            rho[k, i] = new
            sigma_rho[k, i] = max(np.sqrt(1.0 / total), floor_rho)
