"""Bytes to and from a flight controller: URLs, UDP, TCP and serial ports, and signatures."""
