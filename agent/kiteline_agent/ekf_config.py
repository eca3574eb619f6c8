"""Configuration of the Kalman filter."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class EkfConfig:
    """The state's size, its noise, and when a landmark enters or leaves."""

    landmarks: int = 300  # in the state at most: the cost of an update grows with their square
    views: int = 10  # past camera poses in the state, whose rays give new landmarks
    sigma_px: float = 1.0  # deviation of a tracked pixel: templates err by a tenth, but alike over frames
    walk_px: float = 0.4  # px per sqrt(px of parallax): templates err by 0.6 % of the parallax, alike over frames
    gate: float = 10.6  # squared deviations of a pixel beyond which a match is wrong: 0.5 % of right ones
    scale_sigma: float = 0.01  # relative deviation of the odometry's scale, constant over a flight
    path_noise: float = 0.02  # m per sqrt(m) of way: the odometry's white error, along each axis
    turn_noise: float = 0.005  # rad per sqrt(m) of way: the same of the heading
    corners: int = 120  # followed in the image at most
