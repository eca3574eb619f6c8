"""Operating system services: clock, CPU limit, memory, processes, serial ports, key files and shipped data."""
