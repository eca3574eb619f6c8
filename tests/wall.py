"""What tests know of the recording of a wall (the fixture `recording`)."""

STEP_M, PERIOD_S = 0.045, 0.05  # by which the camera slides to its right in a frame; time between two
