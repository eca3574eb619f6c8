"""ArduCopter in software in the loop, with kiteline's agent and rendered cameras, in simulated time."""
