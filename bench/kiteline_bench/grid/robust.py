"""Scans that see badly: what was not seen must stay unknown, and nothing may die."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from kiteline_basestation.grid.grid_view import grid_files
from kiteline_bench.grid.scans import PosedScan, Scanner, as_file, drawn
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_core.arrays import F32, F64
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3
from kiteline_hw.sim.sensors.camera import Shutter
from kiteline_hw.sim.source import SimSource, open_sim
from kiteline_hw.sim.truth.occupancy import FREE as FREE_GREY
from kiteline_hw.sim.truth.sight import SeenWorld, look
from kiteline_lab.grids.files import FREE, GridFile
from kiteline_lab.grids.picture import resampled

_SEED = 43
_POSES = 24  # of each case
_FALSE = 0.5  # percent of free cells that may be occupied in truth: one minus the precision that is wanted
_UNSEEN = 3.0  # percent of free cells whose ground could not be seen at all, borders of cells aside
_SHUTTER = Shutter(0.010)
_GAIN, _NOISE = 185.0, (1.2, 0.02)
_FALL_M = 0.1  # below other ground: vehicles on wheels pass half of it
_BLOCK_PX = 16  # of the disparity that is missing at once
_DRAWS = 12  # of what is missing: one draw says 0.1 % of what another one says 1.6 % of
_FAR_M = 1000.0  # by which one keyframe is wrong
_LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class _Case:
    """Scans of one case, and what their true poses could see."""

    scans: list[PosedScan]
    seen: SeenWorld
    bf: float

    def grid(self) -> GridFile:
        """The base's grid of the scans."""
        return as_file(drawn(self.scans, self.bf))


def run(bench: Bench) -> list[Bar]:
    """All cases."""
    source = open_sim("room?objects=1", seed=_SEED, seconds=40.0)
    along = _along(source)
    bars = []
    plain = _case(bench, "along its course", source, along)
    whole_m2 = _free_m2(plain.grid())
    bars += _bars("along its course", plain)
    bars.append(is_true("along its course: free area", "> 5 m2", whole_m2 > 5.0, f"{whole_m2:.1f} m2"))
    draws = _damaged(bench, "half the disparity missing", source, along, [_without_half(k) for k in range(_DRAWS)])
    bars += _bars(f"half the disparity missing, {_DRAWS} draws", *draws)
    bars += _bars("upside down", _case(bench, "upside down", source, [pose @ _rolled() for pose in along]))
    at_ceiling = [_lifted(source, pose) for pose in along]
    bars += _bars("camera at the ceiling", _case(bench, "camera at the ceiling", source, at_ceiling))
    bars += _bars("facing a wall", _case(bench, "facing a wall", source, _at_walls(source)))
    bare = open_sim("room?floor=bare", seed=_SEED, seconds=40.0)
    textureless = _case(bench, "floor without texture", bare, _along(bare), took_off=False)
    bars += _bars("floor without texture", textureless)
    share = _free_m2(textureless.grid()) / max(_true_free_m2(textureless.seen), 1e-9)
    bars.append(
        at_most("floor without texture: free area over what a floor with texture would show", share, 0.05, "", 3)
    )
    for floor in ("ramp", "wave"):
        other = open_sim(f"room?floor={floor}", seed=_SEED, seconds=40.0)
        case = _case(bench, floor, other, _along(other))
        bars += _bars(f"{floor}", case)
        found = _free_m2(case.grid()) / max(_true_free_m2(case.seen), 1e-9)
        bars.append(is_true(f"{floor}: free area over what was seen", ">= 0.7", found >= 0.7, f"{found:.2f}"))
    for floor in ("pits", "steps"):
        other = open_sim(f"room?floor={floor}", seed=_SEED, seconds=40.0)
        bars += _falls(floor, _case(bench, floor, other, _along(other)))
    bars += _outlier(plain)
    return bars


def _falls(name: str, case: _Case) -> list[Bar]:
    """Free cells that lie deeper than a cell in a fall, and free ways of five cells that lead over the edge of one."""
    grid, world = case.grid(), case.seen.world
    rows, columns = np.indices(grid.state.shape)
    corner, free = np.array(grid.origin[:2]), grid.state == FREE

    def depth_m(right: int, up: int) -> F64:
        """Of cells that lie so many to the right and up."""
        xy = corner + grid.cell_m * (np.stack([columns + right, rows + up], -1).reshape(-1, 2) + 0.5)
        return np.asarray(world.floor_m - world.height(xy)).reshape(free.shape)

    inside = np.min([depth_m(*at) for at in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1))], axis=0) > _FALL_M
    edges = ways = 0
    for right, up in ((1, 0), (0, 1)):
        over = np.abs(depth_m(-2 * right, -2 * up) - depth_m(2 * right, 2 * up)) > _FALL_M
        passed = np.all([np.roll(free, (-k * up, -k * right), (0, 1)) for k in range(-2, 3)], axis=0)
        known = np.any([np.roll(grid.state >= 0, (-k * up, -k * right), (0, 1)) for k in range(-2, 3)], axis=0)
        edges, ways = edges + int(np.count_nonzero(over & known)), ways + int(np.count_nonzero(over & passed))
    bars = [at_most(f"{name}: free ways over an edge, of edges beside known cells", 100.0 * ways / max(edges, 1),
                    _FALSE, "%", 2)]  # fmt: skip
    if name == "pits":  # the lower ground between steps may be free
        wrong = 100.0 * int(np.count_nonzero(free & inside)) / max(int(np.count_nonzero(free)), 1)
        bars.append(at_most(f"{name}: free cells that lie in one", wrong, _FALSE, "%", 2))
    return bars


def _bars(name: str, *cases: _Case) -> list[Bar]:
    """Free cells that are occupied in truth, and free cells that could not be seen, of all cases together."""
    n = wrong = unseen = 0
    for case in cases:
        true, seen = case.seen.grid(seen=False), case.seen.grid()
        shape = GridFile(
            true.cell_m, (float(true.corner[0]), float(true.corner[1]), 0.0), np.zeros(true.image.shape, np.int8)
        )
        found = resampled(case.grid(), shape, np.eye(3)) == FREE
        n += int(np.count_nonzero(found))
        wrong += int(np.count_nonzero(found & (true.image != FREE_GREY)))
        unseen += int(np.count_nonzero(found & (seen.image != FREE_GREY) & (true.image == FREE_GREY)))
    wrong_percent, unseen_percent = 100.0 * wrong / max(n, 1), 100.0 * unseen / max(n, 1)
    return [
        at_most(f"{name}: free cells that are not free", wrong_percent, _FALSE, "%", 2),
        at_most(f"{name}: free cells whose ground was out of sight", unseen_percent, _UNSEEN, "%", 2),
    ]


def _outlier(plain: _Case) -> list[Bar]:
    """One keyframe that lies far away changes nothing near, and files stay small."""
    grid = drawn(plain.scans, plain.bf)
    before = as_file(grid)
    far = plain.scans[0].T_w_c.copy()
    far[:2, 3] += _FAR_M
    extra = [*plain.scans, PosedScan(plain.scans[0].scan, far)]
    files = grid_files(drawn(extra, plain.bf))
    after = as_file(drawn(extra, plain.bf))
    same = resampled(after, before, np.eye(3))
    mib = sum(map(len, files.values())) / 2**20
    nowhere = [*plain.scans, PosedScan(plain.scans[0].scan, np.full((4, 4), np.nan))]
    return [
        is_true("one keyframe a kilometre away: all other cells", "as without it", bool((same == before.state).all())),
        at_most("one keyframe a kilometre away: files", mib, 512.0, "MiB", 1),
        is_true("one keyframe without a finite pose", "as without it",
                bool(np.array_equal(as_file(drawn(nowhere, plain.bf)).state, before.state))),
    ]  # fmt: skip


def _case(
    bench: Bench, name: str, source: SimSource, poses: Sequence[F64], *, took_off: bool = True
) -> _Case:  # fmt: skip
    """Render and scan the poses T_w_b (4,4) of a case. took_off: the vehicle knows the ground from there."""
    return _damaged(bench, name, source, poses, (None,), took_off=took_off)[0]


def _damaged(
    bench: Bench, name: str, source: SimSource, poses: Sequence[F64], damages: Sequence[Callable[[F32], F32] | None],
    *, took_off: bool = True,
) -> list[_Case]:  # fmt: skip
    """The same, of images that are rendered once, with each of several damages to their disparity images."""
    bench.say(f"scanning: {name}")
    ground_z = float(source.world.height(poses[0][None, :2, 3])[0]) if took_off else None
    cameras, scanners = source.cameras(), [Scanner(source.rig, damage, ground_z) for damage in damages]
    for k, pose in enumerate(poses):
        still = np.zeros(3)
        left, right = (
            camera.take_image(pose, still, still, _SHUTTER, _GAIN, _NOISE, (_SEED << 20) + 2 * k + side)
            for side, camera in enumerate(cameras)
        )
        for scanner in scanners:
            scanner.scan(Frame(k, left, right), pose)
    true = source.worn.true
    seen = look(source.world, true.left, np.array(poses) @ true.T_b_c)
    return [_Case(scanner.scans(), seen, scanner.camera.bf) for scanner in scanners]


def _along(source: SimSource) -> list[F64]:
    poses = source.ground_truth.T_w_b
    return list(poses[np.linspace(0, len(poses) - 1, _POSES).astype(int)])


def _without_half(draw: int) -> Callable[[F32], F32]:
    """Makes a random half of a disparity image's blocks unknown, another one in each draw and image."""

    def spoilt(disparity: F32) -> F32:
        h, w = disparity.shape
        random = np.random.default_rng([draw, int(np.float64(disparity.sum()))])
        blocks = random.random((-(-h // _BLOCK_PX), -(-w // _BLOCK_PX))) < 0.5
        mask = np.kron(blocks, np.ones((_BLOCK_PX, _BLOCK_PX)))[:h, :w] > 0
        return np.where(mask, np.float32(0.0), disparity)

    return spoilt


def _rolled() -> F64:
    """The body turned by half a turn about the optical axis, which is its z."""
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))


def _lifted(source: SimSource, T_w_b: F64) -> F64:
    """The pose 0.15 m below the ceiling."""
    assert source.world.shell is not None
    shell = source.world.boxes[source.world.shell]
    out = T_w_b.copy()
    out[2, 3] = shell[2] + shell[5] - 0.15
    return out


def _at_walls(source: SimSource) -> list[F64]:
    """Level poses that look straight at the walls of the room from 0.5 to 0.9 m."""
    assert source.world.shell is not None
    shell, out = source.world.boxes[source.world.shell], []
    for k in range(_POSES):
        side, along = k % 4, -0.6 + 1.2 * (k // 4) / max(_POSES // 4 - 1, 1)
        axis, sign = side % 2, 1.0 if side < 2 else -1.0
        position = shell[:3].copy()
        position[axis] += sign * (shell[3 + axis] - 0.5 - 0.1 * (k // 4 % 5))
        position[1 - axis] += along * shell[4 - axis]
        position[2] = source.world.floor_m + 1.3
        yaw = np.arctan2(*((sign, 0.0) if axis else (0.0, sign)))
        turn = se3.so3_exp(np.array([0.0, 0.0, yaw])) @ _LOOKS_AHEAD
        out.append(se3.from_rt(turn, position) @ se3.inverse(source.rig.T_b_c))
    return out


def _free_m2(grid: GridFile) -> float:
    return float(np.count_nonzero(grid.state == FREE)) * grid.cell_m**2


def _true_free_m2(seen: SeenWorld) -> float:
    return float(np.count_nonzero(seen.grid().image == FREE_GREY)) * seen.cell_m**2
