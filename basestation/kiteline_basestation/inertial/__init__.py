"""In: keyframe poses of a monocular map in metres, and the agent's inertial steps. Out: how long its metre is."""
