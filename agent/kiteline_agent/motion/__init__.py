"""Odometry, IMU and image poses enter; predicted, fused and dead-reckoned camera poses leave."""
