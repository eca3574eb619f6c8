"""What users call: fly, replay, evaluate, plot, and tools for logs, maps and machines."""
