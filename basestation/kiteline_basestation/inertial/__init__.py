"""A map's poses, and the inertial steps and gravity of its agents, enter; its scale and its vertical leave."""
