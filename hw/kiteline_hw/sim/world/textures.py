"""Textures with the statistics of natural images, generated from a seed.

The dead leaves model (A. Lee, D. Mumford, J. Huang, "Occlusion models for natural images", 2001) paints opaque shapes
with sizes distributed as r^-3, which gives sharp edges and a power spectrum near f^-2. Materials add 1/f noise, planks,
bricks, posters and windows. Every texture wraps around and has mean 128; its contrast is set by the face that uses it.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kiteline_core.arrays import F32, F64, I32, I64, U8
from kiteline_hw.sim.world.texture_kernels import paint

TEXEL_M = 0.005  # side of the finest texel of a surface texture
DETAIL_M = 0.0015  # side of a texel of the detail texture, which all surfaces use at different offsets
LEVELS = 8
Rng = np.random.Generator


@dataclass(frozen=True, slots=True)
class TexturePool:
    """Mip pyramids of all textures in one array.

    atlas: (bytes,) uint8. table: (textures, 1 + LEVELS) int64: log2 of the side, offset of each level in the atlas.
    names: by texture number; number 0 is the detail texture.
    """

    atlas: U8
    table: I64
    names: tuple[str, ...]

    def index(self, name: str) -> int:
        """The number of a texture. Raises ValueError for an unknown name."""
        return self.names.index(name)

    def image(self, name: str, level: int = 0) -> U8:
        """One level of a texture, (n, n) uint8."""
        k = self.index(name)
        side = 1 << (int(self.table[k, 0]) - level)
        start = int(self.table[k, 1 + level])
        return self.atlas[start : start + side * side].reshape(side, side)


def make_pool(names: tuple[str, ...], seed: int, bits: int = 11) -> TexturePool:
    """Generate the named textures of MAKERS; a trailing digit, as in `leaves2`, selects another one of the kind."""
    parts: list[U8] = []
    everything = ("detail", *names)
    table = np.zeros((len(everything), 1 + LEVELS), np.int64)
    start = 0
    for k, name in enumerate(everything):
        rng = np.random.default_rng([seed, 71, *name.encode()])
        side = 1 << (min(bits, 9) if k == 0 else bits)
        image = _standardised(MAKERS[name.rstrip("0123456789")](rng, side))
        table[k, 0] = side.bit_length() - 1
        level = image
        for m in range(LEVELS):
            table[k, 1 + m] = start
            quantised = np.clip(np.round(level), 0, 255).astype(np.uint8)
            parts.append(quantised.ravel())
            start += quantised.size
            level = 0.25 * (level[::2, ::2] + level[1::2, ::2] + level[::2, 1::2] + level[1::2, 1::2])
    return TexturePool(np.concatenate(parts), table, everything)


def _standardised(image: F32) -> F32:
    """The image with mean 128 and standard deviation 44, clipped to 4..251."""
    image = image - image.mean()
    return np.asarray(np.clip(128.0 + image * (44.0 / max(1e-6, float(image.std()))), 4, 251), np.float32)


def pink(rng: Rng, side: int, slope: float = 1.0, stretch: float = 1.0) -> F32:
    """Noise with amplitude f^-slope, zero mean, unit deviation (side, side); `stretch` > 1 elongates it along u."""
    small = min(side, 1024)
    fy = np.fft.fftfreq(small)[:, None]
    fx = np.fft.rfftfreq(small)[None, :] * stretch
    f = np.sqrt(fx * fx + fy * fy)
    f[0, 0] = 1.0
    white = np.fft.rfft2(rng.standard_normal((small, small)))
    white[0, 0] = 0.0
    out = np.fft.irfft2(white * f**-slope, s=(small, small)).astype(np.float32)
    out /= out.std()
    return np.asarray(np.tile(out, (side // small, side // small)), np.float32)


def shapes(
    rng: Rng, side: int, cover: float, smallest: float, largest: float, spread: float = 40.0, exponent: float = 3.0,
    tone: float = 0.0,
) -> tuple[F32, I32]:  # fmt: skip
    """Random shapes for `paint` that cover the texture `cover` times; radii from `smallest` to `largest` texels."""
    power = 1.0 - exponent

    def radii(n: int) -> F64:
        u = rng.random(n)
        return np.asarray((smallest**power + u * (largest**power - smallest**power)) ** (1.0 / power))

    mean_area = 2.2 * float((radii(20000) ** 2).mean())
    n = max(8, int(cover * side * side / mean_area))
    r = radii(n)
    aspect = np.exp(rng.uniform(-0.7, 0.7, n))
    angle = rng.uniform(0, np.pi, n)
    value = tone + spread * rng.standard_normal(n)
    gradient = rng.normal(0, 0.12 * spread, (2, n))
    out = np.empty((n, 9), np.float32)
    out[:, 0], out[:, 1] = rng.uniform(0, side, n), rng.uniform(0, side, n)
    out[:, 2], out[:, 3] = r * np.sqrt(aspect), r / np.sqrt(aspect)
    out[:, 4], out[:, 5] = np.cos(angle), np.sin(angle)
    out[:, 6], out[:, 7:] = value, gradient.T
    return out, rng.choice(np.array([0, 0, 0, 1, 1, 1, 2, 3], np.int32), n)


def leaves(rng: Rng, side: int) -> F32:
    """Dead leaves with weak 1/f noise on top."""
    image = np.zeros((side, side), np.float32)
    smallest = float(rng.uniform(2.5, 4.5))
    paint(*shapes(rng, side, 5.0, smallest, side * 0.12), image)
    return np.asarray(image + 4.0 * pink(rng, side), np.float32)


def clutter(rng: Rng, side: int) -> F32:
    """A noisy background with groups of objects: densely covered and nearly bare areas."""
    image = 30.0 * pink(rng, side, 1.3)
    paint(*shapes(rng, side, 0.5, 10.0, side * 0.08, 30.0, 2.2), image)
    small, kinds = shapes(rng, side, 0.8, 2.0, 30.0, 45.0)
    busy = pink(rng, side, 1.6)
    here = busy[small[:, 1].astype(int) % side, small[:, 0].astype(int) % side] > 0.3
    paint(np.ascontiguousarray(small[here]), np.ascontiguousarray(kinds[here]), image)
    return np.asarray(image + 5.0 * pink(rng, side, 0.8), np.float32)


def plaster(rng: Rng, side: int) -> F32:
    """A wall with little texture: stains, hairline cracks, a few marks."""
    image = 14.0 * pink(rng, side, 1.5) + 4.0 * pink(rng, side, 0.7)
    paint(*_strokes(rng, side, 30, (60.0, 200.0), (0.6, 1.2), -30.0), image)
    paint(*shapes(rng, side, 0.02, 2.0, 40.0, 30.0), image)
    return image


def concrete(rng: Rng, side: int) -> F32:
    """Stains, pores and formwork joints."""
    image = 22.0 * pink(rng, side, 1.3) + 7.0 * pink(rng, side, 0.5)
    paint(*shapes(rng, side, 0.08, 1.5, 12.0, 35.0, tone=-15.0), image)
    paint(*_strokes(rng, side, 40, (40.0, 300.0), (0.7, 2.0), -40.0), image)
    paint(*shapes(rng, side, 0.25, 20.0, side * 0.07, 16.0), image)
    return image


def wood(rng: Rng, side: int) -> F32:
    """Boards along u, of different tone, with grain and knots."""
    grain = 10.0 * pink(rng, side, 1.1, 14.0) + 4.0 * pink(rng, side, 0.8, 4.0)
    image = np.zeros((side, side), np.float32)
    y = 0
    while y < side:
        height = min(int(rng.integers(14, 34)), side - y)
        x = int(rng.integers(0, side))
        end = x + side
        while x < end:
            length = min(int(rng.integers(120, 420)), end - x)
            xs = np.arange(x, x + length) % side
            ys = np.arange(y, y + height)
            shift_x, shift_y = rng.integers(0, side, 2)
            rows, cols = (ys + shift_y) % side, (xs + shift_x) % side
            image[np.ix_(ys, xs)] = 24.0 * rng.standard_normal() + grain[np.ix_(rows, cols)]
            image[ys[0], xs] -= 45.0
            image[ys, xs[0]] -= 45.0
            x += length
        y += height
    paint(*shapes(rng, side, 0.012, 2.0, 9.0, 12.0, tone=-40.0), image)
    return image


def brick(rng: Rng, side: int) -> F32:
    """Courses of bricks of unequal height and length in mortar."""
    image = np.full((side, side), 30.0, np.float32)
    rough = 7.0 * pink(rng, side, 0.8) + 9.0 * pink(rng, side, 1.4)
    y = 0
    while y < side:
        height = min(int(rng.integers(14, 30)), side - y)
        x = int(rng.integers(0, side))
        end = x + side
        while x < end:
            length = min(int(rng.integers(25, 75)), end - x)
            cut = rng.integers(1, 3, 4)
            ys = np.arange(y + cut[0], max(y + cut[0] + 1, y + height - cut[1])) % side
            xs = np.arange(x + cut[2], max(x + cut[2] + 1, x + length - cut[3])) % side
            image[np.ix_(ys, xs)] = 26.0 * rng.standard_normal() - 8.0
            x += length
        y += height
    image += rough
    paint(*shapes(rng, side, 0.1, 1.5, 20.0, 26.0), image)
    return image


def posters(rng: Rng, side: int) -> F32:
    """A wall with overlapping pictures and printed pages."""
    image = 12.0 * pink(rng, side, 1.4) + 4.0 * pink(rng, side, 0.7)
    picture = leaves(rng, side)
    tone = 25.0 * pink(rng, side, 1.5)
    for _ in range(max(4, int(70 * (side / 2048) ** 2))):
        w, h = (int(v) for v in rng.integers(40, 240, 2))
        w, h = min(w, side // 3), min(h, side // 3)
        x, y, sx, sy = (int(v) for v in rng.integers(0, side, 4))
        ys, xs = (np.arange(h) + y) % side, (np.arange(w) + x) % side
        base = 35.0 * rng.standard_normal()
        contrast = rng.uniform(0.3, 1.0)
        source = picture if rng.random() < 0.5 else tone
        from_y, from_x = (np.arange(h) + sy) % side, (np.arange(w) + sx) % side
        image[np.ix_(ys, xs)] = base + contrast * source[np.ix_(from_y, from_x)]
        if source is tone:
            _print_words(rng, image, ys, xs, base - 55.0)
    return np.asarray(image + 3.0 * pink(rng, side, 0.8), np.float32)


def _print_words(rng: Rng, image: F32, ys: I64, xs: I64, ink: float) -> None:
    """Print lines of words on a page of these rows and columns."""
    row = 8
    while row < len(ys) - 8:
        size = int(rng.integers(2, 6))
        column = 6
        while column < len(xs) - 12:
            word = int(rng.integers(4, 18))
            if rng.random() < 0.85:
                cells = np.ix_(ys[row : row + size], xs[column : min(column + word, len(xs) - 6)])
                image[cells] = ink + 12.0 * rng.standard_normal()
            column += word + int(rng.integers(2, 5))
        row += size + int(rng.integers(3, 9))


def asphalt(rng: Rng, side: int) -> F32:
    """Grain, patches, cracks, oil."""
    image = 14.0 * pink(rng, side, 0.6) + 12.0 * pink(rng, side, 1.5)
    paint(*shapes(rng, side, 0.15, 40.0, side * 0.12, 16.0), image)
    paint(*_strokes(rng, side, 120, (30.0, 260.0), (0.8, 2.2), -35.0), image)
    paint(*shapes(rng, side, 0.08, 1.5, 20.0, 30.0), image)
    return np.asarray(image + 6.0 * pink(rng, side, 0.5), np.float32)


def foliage(rng: Rng, side: int) -> F32:
    """Small leaves with dark gaps between them."""
    image = 25.0 * pink(rng, side, 1.4) - 30.0
    paint(*shapes(rng, side, 2.0, 3.0, 60.0, 34.0, 2.6), image)
    return np.asarray(image + 18.0 * pink(rng, side, 1.4) + 5.0 * pink(rng, side, 0.6), np.float32)


def facade(rng: Rng, side: int) -> F32:
    """A house front of plaster or brick: windows of unequal size, and a few doors."""
    image = 0.5 * brick(rng, side) if rng.random() < 0.5 else 0.8 * plaster(rng, side)
    image += 15.0 * pink(rng, side, 1.5)
    storey = side // 4 if side >= 1024 else side // 2
    inside = leaves(rng, side)
    for floor in range(0, side, storey):
        x = int(rng.integers(0, storey // 2))
        while x < side - storey // 3:
            w = int(storey * rng.uniform(0.28, 0.5))
            low = floor + int(storey * (0.05 if rng.random() < 0.1 else rng.uniform(0.3, 0.42)))
            high = floor + int(storey * rng.uniform(0.78, 0.9))
            xs, ys = np.arange(x, min(x + w, side)), np.arange(low, min(high, side))
            image[np.ix_(ys, xs)] = 40.0 + 10.0 * rng.standard_normal()  # frame
            inner_x, inner_y = xs[3:-3], ys[3:-3]
            pane = -60.0 + 12.0 * rng.standard_normal() + 0.35 * inside[np.ix_(inner_y, inner_x)]
            pane += rng.normal(0, 18.0) * np.linspace(-1, 1, inner_y.size)[:, None]
            image[np.ix_(inner_y, inner_x)] = pane
            if rng.random() < 0.7 and inner_x.size:
                bar = inner_x.size // 2
                image[np.ix_(inner_y, inner_x[bar - 1 : bar + 2])] = 35.0
            x += w + int(storey * rng.uniform(0.12, 0.7))
    paint(*shapes(rng, side, 0.05, 2.0, 50.0, 25.0), image)
    return np.asarray(image + 3.0 * pink(rng, side, 0.8), np.float32)


def tiles(rng: Rng, side: int) -> F32:
    """The same tile again and again, with joints."""
    tile = min(side, 64)
    motif = np.zeros((tile, tile), np.float32)
    paint(*shapes(rng, tile, 1.2, 2.0, 14.0, 40.0), motif)
    motif[:3] = motif[:, :3] = -60.0
    return np.asarray(np.tile(motif, (side // tile, side // tile)), np.float32)


def clouds(rng: Rng, side: int) -> F32:
    """A soft sky."""
    return pink(rng, side, 1.9)


def detail(rng: Rng, side: int) -> F32:
    """Grain and specks finer than a texel of the other textures."""
    image = 20.0 * pink(rng, side, 0.8)
    paint(*shapes(rng, side, 0.3, 1.5, 12.0, 25.0), image)
    return image


def _strokes(
    rng: Rng, side: int, count: int, length: tuple[float, float], width: tuple[float, float], tone: float
) -> tuple[F32, I32]:
    """Cracks: chains of thin rectangles of wandering direction. `count` is are for a texture of 2048 texels."""
    rows = []
    for _ in range(max(1, int(count * (side / 2048) ** 2))):
        x, y = rng.uniform(0, side, 2)
        angle, half = rng.uniform(0, 2 * np.pi), rng.uniform(*width)
        left = rng.uniform(*length)
        while left > 0:
            step = rng.uniform(5, 15)
            c, s = np.cos(angle), np.sin(angle)
            rows.append((x + c * step, y + s * step, step, half, c, s, tone, 0.0, 0.0))
            x, y, left = x + 2 * c * step, y + 2 * s * step, left - 2 * step
            angle += rng.normal(0, 0.4)
    return np.array(rows, np.float32), np.ones(len(rows), np.int32)


MAKERS: dict[str, Callable[[Rng, int], F32]] = {
    "leaves": leaves,
    "clutter": clutter,
    "plaster": plaster,
    "concrete": concrete,
    "wood": wood,
    "brick": brick,
    "posters": posters,
    "asphalt": asphalt,
    "foliage": foliage,
    "facade": facade,
    "tiles": tiles,
    "clouds": clouds,
    "detail": detail,
}
