"""Installs kiteline's services: a place and an interpreter enter, files of systemd, udev and their folders leave."""
