"""The odometer against poses that are known: when it is believed, what it is worth, where it says that one is."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kiteline_agent.config import OdometerConfig
from kiteline_agent.motion.odometer import Odometer
from kiteline_core import odometry
from kiteline_core.arrays import F64
from kiteline_core.frame import UNMEASURED, OdometryBatch
from kiteline_core.geometry import se3

FRAME_NS, SAMPLE_NS = 50_000_000, 20_000_000
# a camera that looks ahead from a body whose x points ahead and z up, 0.3 m in front of it
T_B_C = se3.from_rt(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.3, 0.0, 0.1]))


def body_at(t_s: float) -> F64:
    """A body that swerves through a hall and climbs and sinks, nose along its way."""
    x = np.array([1.2 * t_s, np.sin(0.9 * t_s), 0.2 * np.sin(0.7 * t_s)])
    yaw, roll = np.arctan2(0.9 * np.cos(0.9 * t_s), 1.2), 0.1 * np.sin(1.3 * t_s)
    return se3.from_rt(se3.so3_exp(np.array([0.0, 0.0, yaw])) @ se3.so3_exp(np.array([roll, 0.0, 0.0])), x)


def camera_at(t_s: float) -> F64:
    return body_at(t_s) @ T_B_C


@cache
def true_twists(seconds: float) -> F64:
    t_s = np.arange(0, round(seconds * 1e9), SAMPLE_NS) * 1e-9
    return np.array([se3.log(se3.inverse(body_at(t)) @ body_at(t + 1e-5)) / 1e-5 for t in t_s])


def driven(seconds: float, noise: float = 0.02, seed: int = 0) -> OdometryBatch:
    """What a good odometer says of it, every 20 ms."""
    rng = np.random.default_rng(seed)
    t_ns = np.arange(0, round(seconds * 1e9), SAMPLE_NS, dtype=np.int64)
    values = true_twists(seconds) + noise * rng.standard_normal((len(t_ns), 6)) * ([1.0] * 3 + [0.3] * 3)
    cov = np.tile(max(noise, 1e-3) ** 2 * np.eye(3), (len(t_ns), 1, 1))
    return OdometryBatch(t_ns, values[:, :3], values[:, 3:], cov, 0.1 * cov)


class Flown:
    """Frames in sight of the truth, then blind ones, at 20 Hz; samples come with the frame that follows them."""

    def __init__(
        self, batch: OdometryBatch | None, seconds: float, blind_from_s: float = 1e9, unit_m: float = 1.0,
        metric: bool = True, config: OdometerConfig | None = None, arrives: float = 0.0,
    ) -> None:  # fmt: skip
        self.odometer = Odometer(T_B_C, config or OdometerConfig(), metric=metric)
        self.events: list[str] = []
        self.pose, self.cov = camera_at(0.0), np.zeros((6, 6))
        self.trusted: list[bool] = []
        done = 0
        for k in range(round(seconds * 20)):
            t_ns = k * FRAME_NS
            if batch is not None:
                end = int(np.searchsorted(batch.t_ns, t_ns - arrives * 1e9, side="right"))
                self.odometer.add(odometry.chosen(batch, slice(done, end)))
                done = end
            predicted = self.odometer.predict(self.pose, t_ns)
            if k == 0:
                self.odometer.restart(self.seen(t_ns, unit_m), t_ns)
            elif t_ns < blind_from_s * 1e9:
                self.pose = self.seen(t_ns, unit_m)
                self.odometer.update(self.pose, t_ns)
            else:
                self.pose = self.pose if predicted is None else predicted
                cov = self.odometer.dead_reckon(self.pose, t_ns)
                self.cov = self.cov if cov is None else cov
            self.events += self.odometer.take_events()
            self.trusted.append(self.odometer.trusted)

    @staticmethod
    def seen(t_ns: int, unit_m: float) -> F64:
        T = camera_at(t_ns * 1e-9)
        return se3.from_rt(T[:3, :3], T[:3, 3] / unit_m)

    def error(self, seconds: float) -> F64:
        """(6,) of the body's pose, [translation in m, rotation about the body's axes]."""
        found = self.pose @ se3.inverse(T_B_C)
        true = body_at(round(seconds * 20 - 1) * FRAME_NS * 1e-9)
        return np.concatenate([found[:3, 3] - true[:3, 3], se3.so3_log(true[:3, :3].T @ found[:3, :3])])


def test_a_good_odometer_is_believed_within_a_second_or_so_of_motion() -> None:
    flown = Flown(driven(3.0), 3.0)
    assert flown.trusted.index(True) <= 20
    assert all(flown.trusted[20:])
    assert len(flown.events) == 1
    assert flown.events[0].startswith("odometer: agrees with what is seen, its scale is ")
    report = flown.odometer.report()
    assert report["scale"] == pytest.approx(1.0, abs=0.01)
    assert report["noise_m_s"] < 0.04


def test_two_seconds_without_images_cost_centimetres() -> None:
    errors = np.array([Flown(driven(6.0, seed=s), 6.0, blind_from_s=4.0).error(6.0) for s in range(6)])
    assert np.linalg.norm(errors[:, :3], axis=1).max() < 0.06  # of 3 m
    assert np.linalg.norm(errors[:, 3:], axis=1).max() < 0.02
    assert np.linalg.norm((camera_at(5.95) - camera_at(3.95))[:3, 3]) > 2.0


def test_the_covariance_of_dead_reckoning_is_consistent() -> None:
    """Never flattering; of an odometer without errors that last it tells of those that may."""
    for noise, least in ((0.01, 0.0), (0.05, 0.12), (0.15, 0.38)):
        nees = []
        for seed in range(8):
            flown = Flown(driven(5.0, noise, seed), 5.0, blind_from_s=3.0)
            error = flown.error(5.0)
            nees.append(float(error @ np.linalg.solve(flown.cov + 1e-9 * np.eye(6), error)))
            assert np.sqrt(np.trace(flown.cov[:3, :3])) < 0.06 * 3.0 + 2.0 * noise
        assert least < np.mean(nees) < 9.0, (noise, nees)  # 6 is what white noise alone would give


def test_its_scale_is_found_and_taken_off() -> None:
    batch = driven(8.0)
    off = replace(batch, velocity=1.05 * batch.velocity)
    flown = Flown(off, 8.0, blind_from_s=6.0)
    assert flown.odometer.scale == pytest.approx(1 / 1.05, abs=0.005)
    assert np.linalg.norm(flown.error(8.0)[:3]) < 0.06  # 5 % of 3 m would be 0.15


def test_noise_does_not_bias_its_scale() -> None:
    scales = [Flown(driven(20.0, 0.4, seed), 20.0).odometer.scale for seed in range(6)]
    assert np.mean(scales) == pytest.approx(1.0, abs=0.012)


def dead(batch: OdometryBatch) -> OdometryBatch:
    return replace(batch, velocity=0.0 * batch.velocity, rate=0.0 * batch.rate)


def held(batch: OdometryBatch) -> OdometryBatch:
    return replace(batch, velocity=np.tile(batch.velocity[5], (len(batch.t_ns), 1)))


def mixed_axes(batch: OdometryBatch) -> OdometryBatch:
    """As if forward-right-down were forward-left-up."""
    flip = np.array([1.0, -1.0, -1.0])
    return replace(batch, velocity=batch.velocity * flip, rate=batch.rate * flip)


def in_camera_axes(batch: OdometryBatch) -> OdometryBatch:
    return replace(batch, velocity=batch.velocity @ T_B_C[:3, :3], rate=batch.rate @ T_B_C[:3, :3])


def in_world_axes(batch: OdometryBatch) -> OdometryBatch:
    r = np.array([body_at(t * 1e-9)[:3, :3] for t in batch.t_ns])
    return replace(batch, velocity=np.einsum("nij,nj->ni", r, batch.velocity))


def in_feet(batch: OdometryBatch) -> OdometryBatch:
    return replace(batch, velocity=batch.velocity * 3.28)


BAD = (dead, in_camera_axes, in_feet)


@pytest.mark.parametrize("spoil", BAD)
def test_what_disagrees_is_never_used(spoil: object) -> None:
    flown = Flown(spoil(driven(6.0)), 6.0)  # type: ignore[operator]
    assert not any(flown.trusted)
    assert flown.odometer.velocity(6_000_000_000) is None


def test_what_agrees_by_chance_for_a_while_is_not_used_for_long() -> None:
    """On a straight piece of the way even wrong axes are right."""
    assert np.mean(Flown(in_world_axes(driven(12.0)), 12.0).trusted) < 0.35


@pytest.mark.parametrize("spoil", [held, mixed_axes])
def test_what_is_half_right_does_no_harm(spoil: object) -> None:
    """A vehicle that flies ahead at an even speed hides wrong sides and a stuck speedometer: no worse than without."""
    for blind_s in (6.0, 7.0, 8.0):
        with_it = Flown(spoil(driven(9.0)), blind_s + 1.0, blind_from_s=blind_s)  # type: ignore[operator]
        without = Flown(None, blind_s + 1.0, blind_from_s=blind_s)
        assert np.linalg.norm(with_it.error(blind_s + 1.0)) < np.linalg.norm(without.error(blind_s + 1.0))


def test_a_slip_ends_the_trust_at_once_and_it_comes_back() -> None:
    batch = driven(12.0)
    velocity = batch.velocity.copy()
    slipping = (batch.t_ns > 4e9) & (batch.t_ns < 5e9)
    velocity[slipping] *= 1.8
    flown = Flown(replace(batch, velocity=velocity), 12.0)
    assert flown.trusted[75]
    assert not any(flown.trusted[88:100])  # within 0.4 s
    assert flown.trusted[-1]
    assert [event.split(",")[0].split(" ")[1] for event in flown.events] == ["agrees", "off", "agrees"]
    assert flown.odometer.scale == pytest.approx(1.0, abs=0.02)  # a slip is no matter of scale


def test_a_short_slip_in_dead_reckoning_is_passed_over() -> None:
    batch = driven(6.0)
    velocity = batch.velocity.copy()
    velocity[(batch.t_ns > 4.5e9) & (batch.t_ns < 4.7e9)] *= 4.0  # 0.2 s: 0.8 m too far
    slipped = Flown(replace(batch, velocity=velocity), 6.0, blind_from_s=4.0)
    assert np.linalg.norm(slipped.error(6.0)[:3]) < 0.15
    assert slipped.odometer.used


@pytest.mark.parametrize("factor", [0.0, 1.6, 3.0])
def test_a_lasting_slip_in_dead_reckoning_is_not_followed(factor: float) -> None:
    batch = driven(6.0)
    velocity = batch.velocity.copy()
    velocity[batch.t_ns > 4.2e9] *= factor
    slipped = Flown(replace(batch, velocity=velocity), 6.0, blind_from_s=4.0)
    plain = Flown(None, 6.0, blind_from_s=4.0)
    error = slipped.error(6.0)
    assert np.linalg.norm(error[:3]) < np.linalg.norm(plain.error(6.0)[:3])
    assert error @ np.linalg.solve(slipped.cov, error) < 22.5  # 99.9 % of 6 degrees of freedom
    assert not slipped.odometer.used


def test_stamps_of_another_clock_are_told_of() -> None:
    batch = driven(6.0)
    flown = Flown(replace(batch, t_ns=batch.t_ns - 3_600_000_000_000), 6.0)
    assert not any(flown.trusted)
    assert flown.events == ["odometer: none of its stamps lies between those of frames, not used"]


def test_an_odometer_that_falls_silent_is_not_guessed_at() -> None:
    batch = driven(6.0)
    flown = Flown(odometry.chosen(batch, batch.t_ns < 4_000_000_000), 6.0)
    assert flown.trusted[70]
    blind = Flown(odometry.chosen(batch, batch.t_ns < 4_500_000_000), 6.0, blind_from_s=4.0)
    assert not blind.odometer.used
    error = blind.error(6.0)
    assert error @ np.linalg.solve(blind.cov, error) < 22.5
    assert flown.odometer.predict(flown.pose, 6_000_000_000) is None
    assert not flown.odometer.predicts


def test_one_stamp_of_the_future_does_not_silence_it() -> None:
    batch = driven(6.0)
    t_ns = batch.t_ns.copy()
    t_ns[120] += 3_600_000_000_000
    flown = Flown(None, 0.0)
    odometer = flown.odometer
    odometer.restart(camera_at(0.0), 0)
    for k in range(1, 120):
        now_ns = k * FRAME_NS
        mine = (batch.t_ns > now_ns - FRAME_NS) & (batch.t_ns <= now_ns)
        odometer.add(odometry.chosen(replace(batch, t_ns=t_ns), mine))
        odometer.update(camera_at(now_ns * 1e-9), now_ns)
    assert odometer.trusted
    assert odometer.predict(camera_at(5.95), 6_000_000_000) is not None


def test_a_sudden_turn_in_the_dark_is_followed() -> None:
    """A gust turns a vehicle by 3 rad/s from one frame to the next: nothing that its inertia forbids."""
    flown = Flown(driven(4.0), 4.0)
    odometer, pose = flown.odometer, flown.pose
    start, cov = pose, 0.01**2 * np.eye(3)[None]
    twist = se3.log(se3.inverse(body_at(3.9)) @ body_at(3.95)) / 0.05
    velocity = twist[None, :3]
    for k in range(80, 100):
        now_ns = k * FRAME_NS
        odometer.add(OdometryBatch(np.array([now_ns]), velocity, np.array([[0.0, 0.0, 3.0]]), cov, cov))
        predicted = odometer.predict(pose, now_ns)
        assert predicted is not None
        pose = predicted
        odometer.dead_reckon(pose, now_ns)
    turned = se3.so3_log(T_B_C[:3, :3] @ start[:3, :3].T @ pose[:3, :3] @ T_B_C[:3, :3].T)
    assert turned[2] == pytest.approx(3.0, abs=0.15)  # after a second; the first frame was half a turn's begin


@given(st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=9, max_size=9), st.integers(0, 1000))
@settings(max_examples=25)
def test_no_numbers_break_it(numbers: list[float], seed: int) -> None:
    """Samples that hold anything, among good ones, in sight and in the dark."""
    batch, rng = driven(3.0), np.random.default_rng(seed)
    for k in rng.integers(30, len(batch.t_ns), 12):
        batch.velocity[k] = numbers[:3]
        batch.rate[k] = numbers[3:6]
        batch.velocity_cov[k] = np.diag(numbers[6:])
        if rng.random() < 0.3:
            batch.rate_cov[k] = numbers[6] * np.ones((3, 3))
    flown = Flown(batch, 3.0, blind_from_s=2.0)
    assert np.isfinite(flown.pose).all()
    assert np.isfinite(flown.cov).all()
    assert np.linalg.eigvalsh(flown.cov).min() > -1e-9


def test_without_use_nothing_is_looked_at() -> None:
    flown = Flown(driven(3.0), 3.0, config=OdometerConfig(use=False))
    assert not flown.odometer.has_recent(0)
    assert flown.odometer.report() is None


def test_wheels_tell_what_they_measure_alone() -> None:
    """Velocity ahead and yaw; sideways, up, roll and pitch are nobody's."""
    batch = driven(6.0)
    cov, rate_cov = batch.velocity_cov.copy(), batch.rate_cov.copy()
    velocity, rate = batch.velocity.copy(), batch.rate.copy()
    for i in (1, 2):
        cov[:, i, i], velocity[:, i] = UNMEASURED, 77.0
    for i in (0, 1):
        rate_cov[:, i, i], rate[:, i] = UNMEASURED, -33.0
    flown = Flown(OdometryBatch(batch.t_ns, velocity, rate, cov, rate_cov), 6.0, blind_from_s=5.0)
    assert flown.odometer.trusted
    assert np.linalg.norm(flown.error(6.0)[:3]) < 0.5
    plain = Flown(None, 6.0, blind_from_s=5.0)
    assert np.linalg.norm(plain.error(6.0)[:3]) > 1.0


@pytest.mark.parametrize("unit_m", [0.3, 1.0, 7.0])
def test_the_monocular_unit_becomes_known(unit_m: float) -> None:
    flown = Flown(driven(6.0, 0.05), 6.0, unit_m=unit_m, metric=False)
    found = flown.odometer.metres_per_unit()
    assert found[0] == pytest.approx(unit_m, rel=0.01)
    assert found[1] < 0.02 * unit_m
    early = Flown(driven(6.0, 0.05), 2.5, unit_m=unit_m, metric=False).odometer.metres_per_unit()
    assert early[0] == pytest.approx(unit_m, rel=0.02)
    assert flown.odometer.predict(flown.pose, 6_000_000_000) is None  # not before the map is in metres


def test_a_slip_does_not_move_the_unit() -> None:
    batch = driven(8.0, 0.05)
    velocity = batch.velocity.copy()
    velocity[(batch.t_ns > 3e9) & (batch.t_ns < 5e9)] *= 2.0
    found = Flown(replace(batch, velocity=velocity), 8.0, unit_m=2.0, metric=False).odometer.metres_per_unit()
    assert found[0] == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize("spoil", [dead, in_camera_axes])
def test_no_unit_comes_from_what_disagrees(spoil: object) -> None:
    config = OdometerConfig(unit_wait_s=7.0)
    for seconds in (6.0, 8.0):
        odometer = Flown(spoil(driven(8.0)), seconds, unit_m=2.0, metric=False, config=config).odometer  # type: ignore[operator]
        assert odometer.metres_per_unit() is None
        assert odometer.awaits_scale == (seconds < 7.0)


@given(st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6).map(np.array))
@settings(max_examples=10)
def test_where_the_map_lies_does_not_matter(move: F64) -> None:
    """The same flight in a map that is moved while blind gives the same flight, moved."""
    batch, T = driven(3.0), se3.exp(move)

    def fly(moved: bool) -> tuple[F64, F64]:
        flown = Flown(odometry.chosen(batch, batch.t_ns <= 2_000_000_000), 2.05)
        odometer, pose = flown.odometer, flown.pose
        odometer.add(odometry.chosen(batch, batch.t_ns > 2_000_000_000))
        cov = np.zeros((6, 6))
        for k in range(41, 50):
            predicted = odometer.predict(pose, k * FRAME_NS)
            assert predicted is not None
            pose = predicted
            coasted = odometer.dead_reckon(pose, k * FRAME_NS)
            assert coasted is not None
            cov = coasted
            if k == 44 and moved:
                pose = T @ pose
                odometer.move_map(T)
        return pose, cov

    (pose, cov), (other, other_cov) = fly(False), fly(True)
    np.testing.assert_allclose(T @ pose, other, atol=1e-9)
    turn = np.eye(6)
    turn[:3, :3] = T[:3, :3]
    np.testing.assert_allclose(turn @ cov @ turn.T, other_cov, atol=1e-12)


@pytest.mark.parametrize(("option", "value", "axis", "until_s"), [
    ("floor_m_s", 0.2, 0, 5.0), ("floor_rad_s", 0.1, 3, 5.0), ("accel_m_s2", 4.0, 0, 3.1), ("turn_rad_s2", 8.0, 3, 3.1),
])  # fmt: skip
def test_dead_reckoning_is_as_uncertain_as_its_options_say(
    option: str, value: float, axis: int, until_s: float
) -> None:
    """Errors of the samples; and motion once there are none."""
    batch = odometry.chosen(driven(5.0, noise=0.05), slice(0, round(until_s * 1e9) // SAMPLE_NS))
    usual = Flown(batch, 4.0, blind_from_s=3.0)
    worse = Flown(batch, 4.0, blind_from_s=3.0, config=replace(OdometerConfig(), **{option: value}))
    assert worse.cov[axis, axis] > 1.5 * usual.cov[axis, axis]


@pytest.mark.parametrize(("tolerance_m_s", "used"), [(0.12, False), (1.0, True)])
def test_a_noisy_odometer_is_used_where_that_is_tolerated(tolerance_m_s: float, used: bool) -> None:
    batch = driven(4.0, noise=1.0)
    batch = replace(batch, velocity_cov=1e-4 * batch.velocity_cov)  # more noise than it states
    flown = Flown(batch, 4.0, config=OdometerConfig(tolerance_m_s=tolerance_m_s))
    assert any(flown.trusted) == used
