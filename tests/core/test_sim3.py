"""Similarities are a group that contains the rigid motions, to the last bit."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from kiteline_core.geometry import se3, sim3

F64 = NDArray[np.float64]


@st.composite
def rigid_motions(draw: st.DrawFn) -> F64:
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    return se3.exp(np.concatenate([rng.normal(0.0, 5.0, 3), rng.normal(0.0, 1.0, 3)]))


scales = st.floats(0.01, 100.0)


@given(rigid_motions(), scales)
def test_a_similarity_is_a_rigid_motion_and_a_scale(T: F64, scale: float) -> None:
    S = sim3.of(scale, T)
    assert np.isclose(sim3.scale_of(S), scale, rtol=1e-12)
    assert np.allclose(sim3.rigid(S), T, atol=1e-12)
    assert np.allclose(sim3.normalise(S), S, rtol=1e-9, atol=1e-12)
    points = np.arange(12.0).reshape(4, 3)
    assert np.allclose(se3.transform(S, points), scale * points @ T[:3, :3].T + T[:3, 3])


@given(rigid_motions(), rigid_motions(), rigid_motions(), scales, scales)
def test_group(A: F64, B: F64, T: F64, a: float, b: float) -> None:
    Sa, Sb = sim3.of(a, A), sim3.of(b, B)
    assert np.allclose(sim3.inverse(Sa) @ Sa, np.eye(4), atol=1e-9)
    assert np.isclose(sim3.scale_of(Sa @ Sb), a * b, rtol=1e-9)
    back = sim3.inverse(sim3.normalise(Sa @ Sb))
    assert np.allclose(back, sim3.inverse(Sb) @ sim3.inverse(Sa), rtol=1e-6, atol=1e-6 / min(a * b, 1.0))
    # A body that is carried by one after the other, or by both at once, stands at one place.
    once, twice = sim3.place(Sa @ Sb, T), sim3.place(Sa, sim3.place(Sb, T))
    assert np.allclose(once, twice, rtol=1e-9, atol=1e-6)
    assert np.allclose(sim3.place(sim3.inverse(Sa), sim3.place(Sa, T)), T, atol=1e-7)
    assert np.allclose(sim3.place(Sa, np.stack([T, A]))[0], sim3.place(Sa, T))


@given(rigid_motions(), rigid_motions(), scales, scales)
def test_what_grows_about_a_body_leaves_it_there(A: F64, T: F64, a: float, factor: float) -> None:
    S = sim3.of(a, A)
    longer = sim3.scaled_about(S, factor, T)
    assert np.isclose(sim3.scale_of(longer), a * factor, rtol=1e-9)
    assert np.allclose(sim3.place(longer, T), sim3.place(S, T), atol=1e-6 * max(1.0, a * factor))


@given(rigid_motions(), rigid_motions())
def test_rigid_motions_are_treated_as_ever(A: F64, T: F64) -> None:
    assert sim3.scale_of(A) == 1.0
    assert np.array_equal(sim3.of(1.0, A), A)
    assert np.array_equal(sim3.inverse(A), se3.inverse(A))
    assert np.array_equal(sim3.place(A, T), A @ T)
    assert np.array_equal(sim3.normalise(A), se3.orthonormalise(A))
