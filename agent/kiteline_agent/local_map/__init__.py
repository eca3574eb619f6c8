"""Keyframes and landmarks near the vehicle: keyframes and corrections enter, landmarks in view of a pose leave."""
