"""Ray casting of textured solids: yawed boxes, one room shell seen from inside, a height field, and a sky.

Boxes are culled against the pyramid of each screen tile, so a pixel tests only the few boxes visible in its tile,
nearest first. Textures are mip pyramids, read at the level of the pixel's footprint, with several probes along the long
axis of a grazing footprint. Pixels on the outline of a solid are cast again with four sub-pixel rays.

Functions called per ray are inlined and compiled without reference counting (`_nrt=False`): counting each array
argument atomically would take longer than the ray.

Arrays shared by the kernels (see world.py for their meaning):
boxes (n, 8) float64: centre x y z, half-extent x y z, cos yaw, sin yaw. faces (6 n, 8) float64: texels per metre
along u and v (signed), offset u and v in texels, brightness, contrast (0: bare), texture, then SWAPPED where u and v
are swapped, plus GLOSSY where lights are reflected.
Faces are numbered 2 * axis + (1 where the outward normal is positive). A hit is 6 * box + face, or SKY or GROUND.
"""

import numpy as np
from numba import njit

from kiteline_core.arrays import F32, F64, I32, I64, U8

TILE = 16  # px, side of a screen tile
SKY = -1
GROUND = -2
NO_SHELL = -1  # outdoors
SWAPPED = 1.0
GLOSSY = 2.0
_LIGHTS = 900.0  # texels a unit of direction: spacing of the reflected lights
_WRAP = float(1 << 26)  # makes texel coordinates positive; a multiple of every texture's side
_FACE_LIGHT = (0.86, 0.74, 0.95, 0.80, 0.70, 1.0)  # brightness by outward normal -x +x -y +y -z +z: light from above


@njit(cache=True, nogil=True)
def visible_boxes(boxes: F64, shell: int, o: F64, axis: F64, half_angle: float, near: F64, items: I32) -> int:
    """Boxes that may intersect a cone from `o` (3,), nearest first: indices in `items`, distances in `near` (n,)."""
    count = 0
    for i in range(boxes.shape[0]):
        if i == shell:
            continue
        b = boxes[i]
        dx, dy, dz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        radius = np.sqrt(b[3] * b[3] + b[4] * b[4] + b[5] * b[5])
        if distance > radius:
            along = (dx * axis[0] + dy * axis[1] + dz * axis[2]) / distance
            angle = np.arccos(min(1.0, max(-1.0, along)))
            if angle - np.arcsin(radius / distance) > half_angle:
                continue
        lx = max(0.0, abs(b[6] * dx + b[7] * dy) - b[3])
        ly = max(0.0, abs(-b[7] * dx + b[6] * dy) - b[4])
        lz = max(0.0, abs(dz) - b[5])
        near[count] = np.sqrt(lx * lx + ly * ly + lz * lz)
        items[count] = i
        count += 1
    order = np.argsort(near[:count])
    near[:count] = near[:count][order]
    items[:count] = items[:count][order]
    return count


@njit(cache=True, nogil=True)
def tile_lists(boxes: F64, items: I32, count: int, o: F64, rot: F64, rays: F32, lists: I32, lengths: I32) -> None:
    """For each screen tile the positions in `items` of the boxes that touch its pyramid, in the same order.

    rays (h+2, w+2, 3): unit directions in the camera frame, with a border of one pixel. lists (tiles, >= count).
    """
    height, width = rays.shape[0] - 2, rays.shape[1] - 2
    columns = (width + TILE - 1) // TILE
    corner = np.empty((4, 3))
    planes = np.empty((4, 3))
    for tile in range(lengths.shape[0]):
        x0, y0 = (tile % columns) * TILE, (tile // columns) * TILE
        x1, y1 = min(x0 + TILE, width) + 1, min(y0 + TILE, height) + 1
        for k in range(4):
            r = rays[y0 if k < 2 else y1, x0 if k == 0 or k == 3 else x1]
            for j in range(3):
                corner[k, j] = rot[j, 0] * r[0] + rot[j, 1] * r[1] + rot[j, 2] * r[2]
        for k in range(4):
            a, b = corner[k], corner[(k + 1) % 4]
            planes[k, 0] = a[1] * b[2] - a[2] * b[1]
            planes[k, 1] = a[2] * b[0] - a[0] * b[2]
            planes[k, 2] = a[0] * b[1] - a[1] * b[0]
        n = 0
        for m in range(count):
            b = boxes[items[m]]
            inside = True
            for k in range(4):
                p = planes[k]
                reach = p[0] * (b[0] - o[0]) + p[1] * (b[1] - o[1]) + p[2] * (b[2] - o[2])
                reach += abs(p[0] * b[6] + p[1] * b[7]) * b[3] + abs(p[1] * b[6] - p[0] * b[7]) * b[4]
                if reach + abs(p[2]) * b[5] < 0.0:
                    inside = False
                    break
            if inside:
                lists[tile, n] = m
                n += 1
        lengths[tile] = n


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def box_hit(boxes: F64, i: int, o: F64, dx: float, dy: float, dz: float, from_inside: bool) -> tuple[float, int]:
    """Distance and face at which a ray enters box i (leaves it, `from_inside`), or (inf, 0).

    Slab method (T. Kay, J. Kajiya, 1986).
    """
    ox, oy, c, s = o[0] - boxes[i, 0], o[1] - boxes[i, 1], boxes[i, 6], boxes[i, 7]
    ex, ey, ez = c * dx + s * dy, c * dy - s * dx, dz
    ex = ex if abs(ex) > 1e-12 else 1e-12
    ey = ey if abs(ey) > 1e-12 else 1e-12
    ez = ez if abs(ez) > 1e-12 else 1e-12
    ix, iy, iz = 1.0 / ex, 1.0 / ey, 1.0 / ez
    mx, my, mz = -(c * ox + s * oy) * ix, -(c * oy - s * ox) * iy, (boxes[i, 2] - o[2]) * iz
    sx, sy, sz = boxes[i, 3] * abs(ix), boxes[i, 4] * abs(iy), boxes[i, 5] * abs(iz)
    low, high = max(mx - sx, my - sy, mz - sz), min(mx + sx, my + sy, mz + sz)
    if low > high or high <= 0.0:
        return np.inf, 0
    if from_inside:
        if high == mx + sx:
            return high, 1 if ix > 0.0 else 0
        if high == my + sy:
            return high, 3 if iy > 0.0 else 2
        return high, 5 if iz > 0.0 else 4
    if low <= 0.0:
        return np.inf, 0
    if low == mx - sx:
        return low, 0 if ix > 0.0 else 1
    if low == my - sy:
        return low, 2 if iy > 0.0 else 3
    return low, 4 if iz > 0.0 else 5


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _ground(field: F32, frame: F64, x: float, y: float, channel: int) -> float:
    """Bilinear height (channel 0) or distance to the path (channel 1). frame: x0, y0, cell, largest slope, top."""
    u = min(max((x - frame[0]) / frame[2], 0.0), field.shape[2] - 1.001)
    v = min(max((y - frame[1]) / frame[2], 0.0), field.shape[1] - 1.001)
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    a = field[channel, j, i] * (1.0 - fu) + field[channel, j, i + 1] * fu
    b = field[channel, j + 1, i] * (1.0 - fu) + field[channel, j + 1, i + 1] * fu
    return float(a * (1.0 - fv) + b * fv)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def ground_hit(field: F32, frame: F64, o: F64, dx: float, dy: float, dz: float, limit: float) -> float:
    """Distance at which a ray meets the height field, or inf beyond `limit`.

    Steps bounded by the largest slope never pass the surface; near it secant steps follow.
    """
    fall = frame[3] * np.sqrt(dx * dx + dy * dy) - dz
    if fall <= 1e-9:
        return np.inf
    t, rate, last_t, last_above = 0.0, fall, 0.0, 0.0
    for k in range(64):
        above = o[2] + t * dz - _ground(field, frame, o[0] + t * dx, o[1] + t * dy, 0)
        if abs(above) < 1e-4 + 2e-5 * t:
            return t
        if k > 0 and above < 0.4 and t != last_t:
            rate = min(fall, max((last_above - above) / (t - last_t), 0.2 * fall))
        else:
            rate = fall
        last_t, last_above = t, above
        t += above / rate
        if t > limit:
            return np.inf
    return t


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def cast_ray(
    boxes: F64, shell: int, field: F32, frame: F64, near: F64, items: I32, lists: I32, tile: int, length: int,
    o: F64, dx: float, dy: float, dz: float, far: float,
) -> tuple[float, int]:  # fmt: skip
    best, hit = far, SKY
    if shell >= 0:
        t, face = box_hit(boxes, shell, o, dx, dy, dz, True)
        if t < best:
            best, hit = t, 6 * shell + face
    for k in range(length):
        m = lists[tile, k]
        if near[m] >= best:
            break
        t, face = box_hit(boxes, items[m], o, dx, dy, dz, False)
        if t < best:
            best, hit = t, 6 * items[m] + face
    if field.shape[0] > 0:
        t = ground_hit(field, frame, o, dx, dy, dz, best)
        if t < best:
            best, hit = t, GROUND
    return best, hit


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _bilinear(atlas: U8, base: int, bits: int, u: float, v: float) -> float:
    u += _WRAP - 0.5
    v += _WRAP - 0.5
    i, j = int(u), int(v)
    fu, fv = u - i, v - j
    mask = (1 << bits) - 1
    i0, i1 = i & mask, (i + 1) & mask
    r0, r1 = base + ((j & mask) << bits), base + (((j + 1) & mask) << bits)
    # Unsigned indices: no test for negative ones.
    a00, a01 = float(atlas[np.uint64(r0 + i0)]), float(atlas[np.uint64(r0 + i1)])
    a10, a11 = float(atlas[np.uint64(r1 + i0)]), float(atlas[np.uint64(r1 + i1)])
    low, high = a00 + fu * (a01 - a00), a10 + fu * (a11 - a10)
    return low + fv * (high - low)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def texture_value(atlas: U8, table: I64, k: int, u: float, v: float, lod: float) -> float:
    """Value, 0..255, of texture k at texel (u, v) of its finest level. table (n, 1 + levels): log2 of side, offsets.

    Two mip levels are blended in the middle half between them; elsewhere the nearer one is used.
    """
    last = table.shape[1] - 2
    lod = min(max(lod, 0.0), float(last))
    level = int(lod)
    fraction = (lod - level) * 2.0 - 0.5
    if fraction >= 1.0:
        level += 1
        fraction = 0.0
    bits = table[k, 0] - level
    scale = 1.0 / (1 << level)
    a = _bilinear(atlas, table[k, 1 + level], bits, u * scale, v * scale)
    if fraction <= 0.0:
        return a
    b = _bilinear(atlas, table[k, 2 + level], bits - 1, u * scale * 0.5, v * scale * 0.5)
    return a + (b - a) * fraction


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def _surface(
    atlas: U8, table: I64, faces: F64, n: int, u: float, v: float, eu: float, ev: float,
    across: float, along: float, detail_m: float,
) -> float:  # fmt: skip
    """Radiance of a surface point. u, v in m; (eu, ev) unit direction of the footprint's long side; sides in m."""
    scale = abs(faces[n, 0])
    along = min(along, 12.0 * across)
    probes = min(6, max(1, int(0.7 * along / across + 0.5)))
    lod = np.log2(max(across, along / probes) * scale) - 0.3
    k = int(faces[n, 6])
    total = 0.0
    for i in range(probes):
        s = along * ((i + 0.5) / probes - 0.5) if probes > 1 else 0.0
        us, vs = (u + eu * s) * faces[n, 0] + faces[n, 2], (v + ev * s) * faces[n, 1] + faces[n, 3]
        total += texture_value(atlas, table, k, us, vs, lod)
    value = 1.0 + faces[n, 5] * (total / probes - 128.0) / 128.0
    fine = np.log2(max(along, across) / detail_m)
    if fine < 3.0 and faces[n, 5] != 0.0:  # texture 0 adds detail below the texel size, until it blurs away
        d = texture_value(atlas, table, 0, u / detail_m + faces[n, 3], v / detail_m + faces[n, 2], fine)
        value += 0.10 * min(1.0, 3.0 - fine) * (d - 128.0) / 128.0
    return float(faces[n, 4] * value)


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def shade_hit(
    boxes: F64, faces: F64, shell: int, field: F32, frame: F64, ground: F64, atlas: U8, table: I64,
    detail_m: float, o: F64, dx: float, dy: float, dz: float, t: float, hit: int, pixel: float,
) -> float:  # fmt: skip
    if hit == SKY:
        s = 1.0 / (max(dz, 0.0) + 0.25)
        value = texture_value(atlas, table, int(ground[3, 6]), dx * s * 400.0, dy * s * 400.0, 1.0)
        return float(ground[3, 4] * (1.0 + 0.3 * max(dz, 0.0) + ground[3, 5] * (value - 128.0) / 128.0))
    across = t * pixel
    if hit == GROUND:
        x, y = o[0] + t * dx, o[1] + t * dy
        flat = np.sqrt(dx * dx + dy * dy) + 1e-12
        along = across / max(-dz, 0.02)
        side = _ground(field, frame, x, y, 1)
        values = 0.0
        blend = max(0.04, min(across, 1.0))
        kerb = min(1.0, max(0.0, (side - frame[5]) / blend + 0.5))
        lawn = min(1.0, max(0.0, (side - frame[6]) / blend + 0.5))
        if kerb < 1.0:
            v0 = _surface(atlas, table, ground, 0, x, y, dx / flat, dy / flat, across, along, detail_m)
            values += (1.0 - kerb) * v0
        if kerb > 0.0 and lawn < 1.0:
            v1 = _surface(atlas, table, ground, 1, x, y, dx / flat, dy / flat, across, along, detail_m)
            values += kerb * (1.0 - lawn) * v1
        if lawn > 0.0:
            values += lawn * _surface(atlas, table, ground, 2, x, y, dx / flat, dy / flat, across, along, detail_m)
        return values
    index, number = hit // 6, hit % 6
    px, py = o[0] + t * dx - boxes[index, 0], o[1] + t * dy - boxes[index, 1]
    pz = o[2] + t * dz - boxes[index, 2]
    c, s = boxes[index, 6], boxes[index, 7]
    lx, ly = c * px + s * py, c * py - s * px
    ex, ey = c * dx + s * dy, c * dy - s * dx
    if number < 2:
        u, v, eu, ev, slope = ly, pz, ey, dz, abs(ex)
    elif number < 4:
        u, v, eu, ev, slope = lx, pz, ex, dz, abs(ey)
    else:
        u, v, eu, ev, slope = lx, ly, ex, ey, abs(dz)
    swapped, glossy = faces[hit, 7] % GLOSSY >= SWAPPED, faces[hit, 7] >= GLOSSY
    if swapped:
        u, v, eu, ev = v, u, ev, eu
    length = np.sqrt(eu * eu + ev * ev) + 1e-12
    light = _FACE_LIGHT[number ^ 1 if index == shell else number]
    floor_gap = pz + boxes[index, 5]
    if number < 4 and index != shell:  # contact shadow where a solid stands on something
        light *= 1.0 - 0.3 * np.exp(-8.0 * floor_gap)
    value = light * _surface(
        atlas, table, faces, hit, u, v, eu / length, ev / length, across, across / max(slope, 0.02), detail_m
    )
    if glossy:  # reflected lights move over the surface with the camera; they brighten it towards grazing views
        rx, ry, rz = (-ex if number < 2 else ex), (-ey if 2 <= number < 4 else ey), (-dz if number >= 4 else dz)
        k, m = (1.0 / (abs(rz) + 0.6), int(faces[hit, 6]))
        lamp = texture_value(atlas, table, m, _LIGHTS * rx * k, _LIGHTS * ry * k, 3.0)
        value += (0.35 + 0.65 * (1.0 - slope)) * max(0.0, lamp - 150.0) / 100.0
    return value


@njit(cache=True, nogil=True, _nrt=False, forceinline=True)
def sample_ray(rays: F32, rot: F64, y: int, x: int, k: int) -> tuple[float, float, float]:
    """Direction in w of sample k of the four of a pixel, on a rotated grid. rays: of pixels, with a border of one."""
    su = (-0.125, 0.375, -0.375, 0.125)[k]
    sv = (-0.375, -0.125, 0.125, 0.375)[k]
    i, j = y + 1, x + 1
    r0 = rays[i, j, 0] + su * (rays[i, j + 1, 0] - rays[i, j, 0]) + sv * (rays[i + 1, j, 0] - rays[i, j, 0])
    r1 = rays[i, j, 1] + su * (rays[i, j + 1, 1] - rays[i, j, 1]) + sv * (rays[i + 1, j, 1] - rays[i, j, 1])
    r2 = rays[i, j, 2] + su * (rays[i, j + 1, 2] - rays[i, j, 2]) + sv * (rays[i + 1, j, 2] - rays[i, j, 2])
    return (
        rot[0, 0] * r0 + rot[0, 1] * r1 + rot[0, 2] * r2,
        rot[1, 0] * r0 + rot[1, 1] * r1 + rot[1, 2] * r2,
        rot[2, 0] * r0 + rot[2, 1] * r1 + rot[2, 2] * r2,
    )


@njit(cache=True, nogil=True)
def render(
    boxes: F64, faces: F64, shell: int, field: F32, frame: F64, ground: F64, atlas: U8, table: I64,
    detail_m: float, o: F64, rot: F64, rays: F32, pixel: float, far: float,
    near: F64, items: I32, lists: I32, lengths: I32, radiance: F32, distance: F32, hits: I32,
) -> None:  # fmt: skip
    """Fill radiance (h, w), distance along the ray in m (h, w; inf for the sky) and hits (h, w) seen from `o`."""
    height, width = radiance.shape
    columns = (width + TILE - 1) // TILE
    for tile in range(lengths.shape[0]):
        x0, y0 = (tile % columns) * TILE, (tile // columns) * TILE
        for y in range(y0, min(y0 + TILE, height)):
            for x in range(x0, min(x0 + TILE, width)):
                r0, r1, r2 = rays[y + 1, x + 1, 0], rays[y + 1, x + 1, 1], rays[y + 1, x + 1, 2]
                dx = rot[0, 0] * r0 + rot[0, 1] * r1 + rot[0, 2] * r2
                dy = rot[1, 0] * r0 + rot[1, 1] * r1 + rot[1, 2] * r2
                dz = rot[2, 0] * r0 + rot[2, 1] * r1 + rot[2, 2] * r2
                t, hit = cast_ray(
                    boxes, shell, field, frame, near, items, lists, tile, lengths[tile], o, dx, dy, dz, far
                )
                hits[y, x] = hit
                distance[y, x] = t if hit != SKY else np.inf
                radiance[y, x] = shade_hit(
                    boxes, faces, shell, field, frame, ground, atlas, table, detail_m, o, dx, dy, dz, t, hit, pixel
                )
    for y in range(height):
        for x in range(width):
            h = hits[y, x]
            if not (
                (x > 0 and hits[y, x - 1] != h)
                or (x + 1 < width and hits[y, x + 1] != h)
                or (y > 0 and hits[y - 1, x] != h)
                or (y + 1 < height and hits[y + 1, x] != h)
            ):
                continue
            tile = (y // TILE) * columns + x // TILE
            total = 0.0
            for k in range(4):  # rotated grid of four
                dx, dy, dz = sample_ray(rays, rot, y, x, k)
                t, hit = cast_ray(
                    boxes, shell, field, frame, near, items, lists, tile, lengths[tile], o, dx, dy, dz, far
                )
                total += shade_hit(
                    boxes, faces, shell, field, frame, ground, atlas, table, detail_m, o, dx, dy, dz, t, hit, pixel
                )
            radiance[y, x] = 0.25 * total
